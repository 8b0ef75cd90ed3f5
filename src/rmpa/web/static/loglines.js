// Lines of the log: kept while a page shows them, newest first.

import { html, useEffect, useState } from "./markup.js";
import { clock } from "./format.js";
import { Mark, NodeLink } from "./parts.js";

const KEPT = 500;
const MARKS = { DEBUG: "", INFO: "OK", WARN: "WARN", ERROR: "ERROR", FATAL: "ERROR" };
const keyOf = (line) => `${line.n} ${line.at}`;

export function useLog(connection, held) {
  const [lines, setLines] = useState([]);
  useEffect(
    () =>
      held
        ? undefined
        : connection.followLog((more) =>
            setLines((before) => {
              const seen = new Set(before.map(keyOf)); // the server sends what it has kept at each new connection
              return [...more.filter((line) => !seen.has(keyOf(line))).reverse(), ...before].slice(0, KEPT);
            }),
          ),
    [held],
  );
  return lines;
}

export const Lines = ({ lines, empty, bare }) =>
  lines.length
    ? html`<div role="log" aria-label="Log" class=${bare ? "bare" : ""}>
        ${lines.map(
          (line) =>
            html`<div class="logline" key=${keyOf(line)}>
              <time class="muted mono">${clock(line.at)}</time
              ><${Mark} state=${MARKS[line.level]} word=${line.level} />${!bare &&
              html`<${NodeLink} name=${line.node} />`}<span>${line.text}</span>
            </div>`,
        )}
      </div>`
    : html`<p class="empty">${empty}</p>`;
