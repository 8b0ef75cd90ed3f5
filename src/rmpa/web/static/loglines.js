// Lines of the log of all modules or of some: asked for while a page shows them, and it is seen.

import { html, memo, useEffect, useRef, useState } from "./markup.js";
import { useAgain } from "./asking.js";
import { clock, seconds } from "./format.js";
import { Failure, Mark } from "./parts.js";
import { ModuleLink, NodeLink, nodeKey } from "./links.js";

const KEPT = 500; // lines of a page
const PERIOD = 1; // seconds from an answer to the next question
const MARKS = { debug: "", info: "OK", warn: "WARN", error: "ERROR", fatal: "ERROR" };
const SURE = 1e-3; // s; a bound of a line's time that is smaller is not shown

// The lines that `wanted` asks for (`modules`, `node`, `level`), the newest first; and what is missing. The server
// keeps nothing for a page: each question has the number of the last line of each module.
export function useLog(connection, wanted, held = false) {
  const [state, set] = useState({ lines: [], problems: [] });
  const after = useRef({});
  const key = JSON.stringify(wanted);
  useEffect(() => {
    after.current = {};
    set({ lines: [], problems: [], waits: true });
  }, [key]);
  useAgain(!held && connection.phase === "open", PERIOD, key, async (still) => {
    const told = await connection.told("log", { ...wanted, after: after.current });
    if (still()) set((before) => merged(before, told, after.current));
  });
  return state;
}

function merged(before, { value, failure }, after) {
  if (failure) return { ...before, failure, waits: false };
  const fresh = [];
  const problems = [];
  for (const { module, lines = [], next = 0, lost = [], error, problem } of value) {
    if (problem) problems.push(`${module}: ${problem}`);
    else after[module] = next;
    for (const node of lost) problems.push(`${module}:${node} writes more than is kept: lines of it are missing`);
    for (const line of lines) fresh.push({ ...line, module, error, key: `${module} ${line.n}` });
  }
  if (!fresh.length && !before.failure && !before.waits && String(problems) === String(before.problems)) return before;
  const seen = new Set(fresh.map((line) => line.key)); // two answers may have crossed
  const lines = [...fresh, ...before.lines.filter((line) => !seen.has(line.key))].sort((a, b) => b.at - a.at);
  return { lines: fresh.length ? lines.slice(0, KEPT) : before.lines, problems };
}

const time = (line) => `${clock(line.at)}.${String(Math.floor((line.at % 1) * 1000)).padStart(3, "0")}`;
const bound = (line) => (line.error === undefined || line.error === null ? "±?" : `± ${seconds(line.error)}`);

// A line of a module whose clock is not known well says so: its place among lines of others is as uncertain.
const Line = memo(
  ({ line, bare, own }) =>
    html`<div class="logline">
      <time class="muted mono" title=${line.module === own ? undefined : `by this module's clock, ${bound(line)}`}
        >${time(line)}${line.module !== own && !(line.error < SURE) && html` <small>${bound(line)}</small>`}</time
      ><${Mark} state=${MARKS[line.level]} word=${line.level} />${!bare &&
      html`<span class="source"
        >${line.agent
          ? html`<${ModuleLink} name=${line.module} /> <b class="tag">agent</b>`
          : html`<${NodeLink} name=${nodeKey(line.module === own ? "" : line.module, line.node)}
              >${`${line.module}:${line.node}`}<//
            >`}</span
      >`}<span class="text">${line.text}</span>
    </div>`,
);

export const Lines = ({ lines, empty, bare, own }) =>
  lines.length
    ? html`<div role="log" aria-label="Log" class=${bare ? "bare" : ""}>
        ${lines.map((line) => html`<${Line} key=${line.key} line=${line} bare=${bare} own=${own} />`)}
      </div>`
    : html`<p class="empty">${empty}</p>`;

// What is missing in the lines that are shown.
export const Missing = ({ log }) =>
  html`<${Failure} failure=${log.failure} />${log.problems.map(
      (text) => html`<p class="missing" key=${text}><${Mark} state="WARN" word="" />${text}</p>`,
    )}`;
