// The recordings of all modules, and one of them: what happened, in order, and its files.

import { html, useEffect, useRef, useState } from "../markup.js";
import { bytes, clock, count, duration } from "../format.js";
import { section } from "../state.js";
import { Failure, Mark, Page, Panel, Text, known as level, under } from "../parts.js";
import { Table } from "../lists.js";
import { Link, ModuleLink, href } from "../links.js";
import { useAnswer, useAsk } from "../asking.js";

const PERIOD = 3; // seconds; each module is asked
const BILLION = 1e9; // nanoseconds of a second
const RECORDERS = [
  ["Module", (one) => html`<${ModuleLink} name=${one.module} />`],
  [
    "Recorder",
    ({ status, problem }) => under(html`<${Mark} ...${runs(status, problem)} />`, status.problem || problem),
  ],
  ["#Goes back", ({ status }) => duration(status.ring?.[1])],
  ["#Ring", ({ status }) => bytes(status.ring?.[0])],
];
const runs = ({ pid, problem }, silent) =>
  silent
    ? { state: "WARN", word: "not known" }
    : { state: problem ? "ERROR" : pid ? "up" : "away", word: pid ? "runs" : "none" };
const RECORDINGS = [
  ["Recording", (one) => under(html`<${Link} page="recording" name=${one.name} />`, one.why), (one) => one.name],
  ["When", (one) => clock(one.until / BILLION), (one) => one.until],
  [
    "Modules",
    (one) => one.modules.map((name, at) => [at > 0 && ", ", html`<${ModuleLink} key=${name} name=${name} />`]),
  ],
  ["#Size", (one) => bytes(one.size), (one) => one.size],
];

// One row for what several modules kept for the same reason, the latest first.
function gathered(told) {
  const found = new Map();
  for (const { module, kept } of told)
    for (const { id, why, until = 0, size = 0 } of kept) {
      const one = found.get(id) ?? { name: id, why, until, size: 0, modules: [] };
      found.set(id, { ...one, size: one.size + size, modules: [...one.modules, module] });
    }
  return [...found.values()].sort((a, b) => b.until - a.until);
}

export function Recordings({ connection }) {
  const { last: told, failure } = useAnswer(connection, "recordings", {}, PERIOD);
  const list = gathered(told || []);
  return html`<${Page} title="Recordings" kind=${`${list.length} in all modules`}
    ><${Failure} failure=${failure} />
    <${Panel}
      >${connection.may("control") && html`<${Keep} connection=${connection} />`}
      <${Table}
        caption="Recordings"
        columns=${RECORDINGS}
        list=${list}
        empty=${told
          ? "Nothing is kept: an alarm, a lost peer, a dead node or a person keeps a recording."
          : "Asking …"} /><//
    ><${Panel} title="Recorders"
      ><${Table} caption="Recorders" columns=${RECORDERS} list=${told || []} empty="No module has answered."
    /><//>
  <//>`;
}

const Problems = ({ list = [] }) =>
  list.map(([module, error]) => html`<${Failure} key=${module} failure=${{ error: `${module}: ${error}` }} />`);

function Keep({ connection }) {
  const [why, setWhy] = useState("");
  const [{ told, waits, failure }, ask] = useAsk(
    connection,
    (answer) => (setWhy(""), { told: Object.entries(answer) }),
  );
  const submit = (event) => {
    event.preventDefault();
    ask("keep_recording", { why });
  };
  const failed = told?.filter(([, problem]) => problem);
  return html`<form class="row" onSubmit=${submit}>
    <${Text} label="What happened" value=${why} maxlength="200" onInput=${setWhy} /><button disabled=${waits}>
      Keep the last minutes
    </button>
    <p class="said" role="status">${told && `${told.length - failed.length} of ${told.length} modules keep it.`}</p>
    <${Problems} list=${failed} /><${Failure} failure=${failure} />
  </form>`;
}

async function got(url, how) {
  const response = await fetch(url, how);
  if (!response.ok) throw { error: (await response.json()).detail };
  return response;
}

// Has a file made: how far it is (`doing`, `size`), why it is not there (`failure`), or what `take` makes of its
// address; and the function that begins. The server ends it when the page does.
function useMade(name, kind, take) {
  const [state, set] = useState({});
  const ended = useRef(new AbortController());
  useEffect(() => () => ended.current.abort(), []);
  const make = async () => {
    const { signal } = ended.current;
    const url = new URL(`recording/${encodeURIComponent(name)}.${kind}`, document.baseURI);
    try {
      const reader = (await got(`${url}?progress`, { signal })).body.pipeThrough(new TextDecoderStream()).getReader();
      for (let rest = "", told = {}; !told.ready; ) {
        const { value, done } = await reader.read();
        if (done) throw new Error("it has ended");
        const lines = (rest + value).split("\n");
        rest = lines.pop();
        for (const line of lines) set((told = JSON.parse(line)));
        if (told.error) throw told;
      }
      set(await take(url));
    } catch (error) {
      if (signal.aborted) return;
      set({ failure: error.error ? error : { error: `rmpa web does not answer: ${error.message}` } });
    }
  };
  return [state, make];
}

const DOING = {
  wait: "Waiting for another recording",
  fetch: "Fetching from the modules",
  merge: "Putting them on one timeline",
  bag: "Writing the bag",
  story: "Reading what happened",
};
const Progress = ({ doing, size, total }) =>
  doing &&
  html`<p role="status">
    ${DOING[doing]} … ${size > 0 && total && `${bytes(size)} of ${bytes(total)}`}<br />
    <progress aria-label=${DOING[doing]} value=${total && size ? Math.min(1, size / total) : undefined} />
  </p>`;

function Download({ name, kind }) {
  const [state, make] = useMade(name, kind, (url) => {
    Object.assign(document.createElement("a"), { href: url, download: "" }).click();
    return {};
  });
  return html`<button type="button" disabled=${Boolean(state.doing)} onClick=${make}>Download .${kind}</button
    ><${Progress} ...${state} /><${Failure} failure=${state.failure} />`;
}

export function RecordingPage({ name, state, connection }) {
  const [told, make] = useMade(name, "json", async (url) => ({ story: await (await got(url)).json() }));
  const [sure, setSure] = useState(false);
  const [{ problems, failure }, ask] = useAsk(connection, (answer) => ({ problems: Object.entries(answer) }));
  const { last } = useAnswer(connection, "recordings", {}, PERIOD);
  const about = gathered(last || []).find((one) => one.name === name);
  useEffect(() => void make(), []);
  const remove = () => (sure ? ask("remove_recording", { name }).then(() => setSure(false)) : setSure(true));
  const gone = problems?.length === 0;
  return html`<${Page}
    title=${name}
    kind=${about ? `${about.why} · ${about.modules.join(", ")} · ${bytes(about.size)}` : "Recording"}
    aside=${html`${told.story &&
    ["mcap", "bag", "html"].map((kind) => html`<${Download} key=${kind} ...${{ name, kind }} />`)}
    ${connection.may("control") &&
    !gone &&
    html`<button type="button" onClick=${remove}>${sure ? "Yes, remove it everywhere" : "Remove"}</button>`}`}
    ><${Failure} failure=${failure} /><${Problems} list=${problems} />
    ${gone && html`<p role="status">It is removed. <a href=${href("recordings")}>All recordings</a></p>`}
    <${Progress} ...${told} total=${about?.size} /><${Failure} failure=${told.failure} /> ${told.failure &&
    html`<button type="button" onClick=${make}>Try again</button>`}
    ${told.story && html`<${Story} story=${told.story} topics=${section(state, "topics")} />`}<//
  >`;
}

const LEVELS = { info: "OK", warn: "WARN", error: "ERROR" };
const TOPS = { info: 16, warn: 10, error: 3 }; // of a tick within its row
const ROW = 26;
const WIDE = 1000; // units of a drawing
const time = (at) => `${clock(at / BILLION)}.${String(Math.floor((at / 1e6) % 1000)).padStart(3, "0")}`;
const LINES = [
  ["Time", (line, { begin }) => under(time(line.at), `+${((line.at - begin) / BILLION).toFixed(1)}\u2009s`)],
  [
    "What happened",
    (line) => html`<${Mark} state=${LEVELS[line.level]} word=${line.kind.replaceAll("_", " ")} /><br />${line.text}`,
  ],
  ["Module", (line) => (line.module ? html`<${ModuleLink} name=${line.module} />` : "–")],
  [
    "Seen in",
    ({ evidence }, { known }) =>
      known.includes(evidence) ? html`<${Link} page="topic" name=${evidence} />` : evidence,
  ],
];

function Story({ story, topics }) {
  const [picked, pick] = useState(null);
  const { begin, end, modules, lines } = story;
  const known = [...new Set(lines.map((line) => line.evidence))].filter((topic) => topic in topics);
  return html`<${Panel}
      ><p>
        ${time(begin)} to ${time(end)}: ${duration((end - begin) / BILLION)}, ${count(story.messages)} messages of
        ${` ${modules.join(", ") || "one module"}`}.
      </p>
      ${story.notes.map((note) => html`<p key=${note} class="muted">${note}</p>`)}
      ${lines.length > 0 && html`<${Drawing} ...${{ story, picked, pick }} />`}<//
    ><${Panel} title="What happened"
      ><${Table}
        caption="What happened"
        columns=${LINES}
        list=${lines}
        about=${{ begin, known }}
        tone=${(line) => (line === picked ? "picked" : "")}
        empty="Nothing went wrong: no alarm, no lost link, no gap, no error in the logs."
    /><//>`;
}

// A row for each module with a tick for each line: the worse, the longer. A press picks the nearest one.
function Drawing({ story: { begin, end, modules, lines }, picked, pick }) {
  const rows = modules.length ? modules : [""];
  const x = (line) => ((line.at - begin) / (end - begin || 1)) * WIDE;
  const row = (line) => Math.max(0, rows.indexOf(line.module));
  const point = (event) => {
    const box = event.currentTarget.getBoundingClientRect();
    const across = ((event.clientX - box.left) / box.width) * WIDE;
    const down = Math.floor((event.clientY - box.top) / ROW);
    const far = (line) => Math.abs(x(line) - across) + (row(line) === down ? 0 : WIDE);
    pick(lines.reduce((best, line) => (far(line) < far(best) ? line : best)));
  };
  return html`<div class="trend strips">
      <div class="lanes">${rows.map((name) => html`<div key=${name}>${name || "–"}</div>`)}</div>
      <svg
        class="spells"
        viewBox=${`0 0 ${WIDE} ${rows.length * ROW}`}
        preserveAspectRatio="none"
        role="img"
        aria-label=${`Timeline of ${lines.length} events, which the table below lists`}
        style=${{ height: `${rows.length * ROW}px` }}
        onClick=${point}
      >
        ${rows.map((name, at) => html`<path key=${name} class="base" d=${`M0 ${at * ROW + ROW - 0.5}H${WIDE}`} />`)}
        ${lines.map((line, at) => {
          const [top, tone] = [row(line) * ROW, level(LEVELS[line.level]).tone];
          const d = `M${x(line).toFixed(1)} ${top + TOPS[line.level]}V${top + ROW - 3}`;
          return html`<path key=${at} class=${`tick ${line === picked ? "picked" : tone}`} d=${d} />`;
        })}
      </svg>
      <div></div>
      <p class="axis muted"><span>${time(begin)}</span><span>${time(end)}</span></p>
    </div>
    <p role="status">
      ${picked && html`<strong>${time(picked.at)}</strong> ${picked.module && `${picked.module}: `}${picked.text}`}
    </p>`;
}
