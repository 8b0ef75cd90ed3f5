// What modules can start: resources with their processes, started, stopped and restarted by a button, and their logs.

import { html, useEffect, useRef, useState } from "./markup.js";
import { bytes, percent } from "./format.js";
import { Failure, Mark, Panel, Since, under } from "./parts.js";
import { Table } from "./lists.js";
import { Link, ModuleLink, NodeLink, href, nodeKey } from "./links.js";
import { useAgain, useAnswer, useAsk } from "./asking.js";
import { section } from "./state.js";

const PERIOD = 3; // seconds; each module is asked
const KEPT = 500; // lines of a log
const MARKS = { active: "up", running: "up", starting: "linking", stopping: "linking", waiting: "pending" };
MARKS.failed = MARKS.refused = "ERROR";
const State = ({ state, why }) => under(html`<${Mark} state=${MARKS[state] ?? "away"} word=${state} />`, why);
const sum = (list, key) => (list.length ? list.reduce((total, each) => total + (each[key] || 0), 0) : undefined);
const share = (cpu) => percent(Number.isFinite(cpu) ? 100 * cpu : undefined);
const ago = (moment) => (moment ? html`<${Since} moment=${moment} />` : "–");

const LAUNCHES = [
  [
    "Resource",
    (one, { known, own, may }) => {
      const key = one.module === own ? `/${one.title}` : `${one.module}:/${one.title}`;
      const title = key in known ? html`<${Link} page="resource" name=${key}>${one.title}<//>` : one.title;
      const edits = may && one.module === own && one.file.endsWith(".toml");
      return under(title, edits ? html`<a href=${href("file", one.file)}>${one.file}</a>` : one.file);
    },
    (one) => one.title,
  ],
  ["Module", (one) => html`<${ModuleLink} name=${one.module} />`, (one) => one.module],
  ["State", (one) => html`<${State} ...${one} />`, (one) => one.state],
  ["#Since", (one) => ago(one.since)],
  ["#Restarts", (one) => one.restarts || 0, (one) => one.restarts || 0],
  ["#CPU", (one) => share(sum(one.processes, "cpu")), (one) => sum(one.processes, "cpu")],
  ["#Memory", (one) => bytes(sum(one.processes, "rss")), (one) => sum(one.processes, "rss")],
  [
    "#",
    (one, { may, order, waits }) => {
      const press = (what) => () => order(what, one);
      const button = (what, label) => {
        const about = { disabled: waits === one.name, "aria-label": `${label} ${one.title}`, onClick: press(what) };
        return html`<button type="button" ...${about}>${label}</button>`;
      };
      const runs = one.pid !== undefined && one.pid !== null;
      return (
        may &&
        html`<div class="row orders">
          ${!runs && button("start", "Start")}${(runs || one.state === "waiting") && button("stop", "Stop")}
          ${runs && button("restart", "Restart")}${button("log", "Log")}
        </div>`
      );
    },
  ],
];

// All of them; or `only` that of one file of a module, with the `nodes` that the resource describes.
export function Launches({ state, connection, only, nodes }) {
  const answer = useAnswer(connection, "launches", {}, PERIOD);
  const [ordered, ask] = useAsk(connection);
  const [busy, setBusy] = useState("");
  const [log, setLog] = useState(null);
  const { last: told = [] } = answer;
  const list = told
    .flatMap(({ module, resources }) => resources.map((one) => ({ ...one, module, title: one.name })))
    .filter(({ module, file }) => !only || (module === only.module && file === only.file))
    .map((one) => ({ ...one, name: `${one.module}:${one.name}` }));
  const problems = told.filter((each) => each.problem && !only);
  const order = (what, one) => {
    if (what === "log") return setLog(one);
    setBusy(one.name);
    return ask("launch", { do: what, name: one.title, module: moduleOf(one.module, state) });
  };
  const about = { order, may: connection.may("control"), waits: ordered.waits && busy };
  const own = section(state, "agent").name;
  return html`<${Panel} title=${only ? "Nodes and processes" : "What modules can start"} wide=${Boolean(only)}
    ><${Failure} failure=${ordered.failure} />${!list.length && html`<${Failure} failure=${answer.failure} />`}
    ${problems.map(
      ({ module, problem }) =>
        html`<p class="missing" key=${module}><${Mark} state="WARN" word="" />${module}: ${problem}</p>`,
    )}
    ${!(only && !list.length) &&
    html`<${Table}
      caption="What modules can start"
      columns=${LAUNCHES}
      about=${{ ...about, own, known: section(state, "resources") }}
      list=${list}
      empty=${answer.value || answer.failure ? "No module has files of resources in a configured folder." : "Asking …"}
    />`}
    ${only &&
    html`<${Processes} ...${{ state, nodes }} processes=${list[0]?.processes} peer=${moduleOf(only.module, state)} />`}
    ${log && html`<${Output} key=${log.name} ...${{ connection, state, one: log, close: () => setLog(null) }} />`}<//
  >`;
}
const moduleOf = (module, state) => (module === section(state, "agent").name ? "" : module);

// What a resource and its nodes have written, followed while it is shown.
function Output({ connection, state: { agent }, one, close }) {
  const module = moduleOf(one.module, { agent });
  const [state, set] = useState({ lines: [] });
  const after = useRef({}); // by the node that writes
  const box = useRef();
  useAgain(connection.phase === "open", 1, one.name, (still) =>
    connection
      .told("launch", { do: "log", name: one.title, module, after: after.current, lines: 200 })
      .then(({ value, failure }) => {
        if (!still()) return;
        const fresh = (value?.logs || []).flatMap((each) => {
          after.current[each.source] = each.next;
          return each.lines.map((line) => (each.source ? `${each.source}: ${line}` : line));
        });
        set(({ lines }) => ({ failure, lines: fresh.length ? [...lines, ...fresh].slice(-KEPT) : lines }));
      }),
  );
  useEffect(() => {
    if (box.current) box.current.scrollTop = box.current.scrollHeight;
  }, [state.lines]);
  return html`<section class="output" aria-label=${`Log of ${one.title}`}>
    <header>
      <h3>Log of ${one.name}</h3>
      <button type="button" onClick=${close}>Close</button>
    </header>
    <${Failure} failure=${state.failure} />
    <pre ref=${box} tabindex="0">${state.lines.join("\n") || "Nothing has been written."}</pre>
  </section>`;
}

const PROCESSES = [
  [
    "Node",
    (each, { peer }) => under(html`<${NodeLink} name=${nodeKey(peer, each.node)} />`, each.key, each.how),
    (each) => each.node,
  ],
  ["State", (each) => html`<${State} ...${each} />`],
  ["#PID", (each) => each.pid || "–"],
  ["#CPU", (each) => share(each.cpu), (each) => each.cpu],
  ["#Memory", (each) => bytes(each.rss), (each) => each.rss],
  ["#Restarts", (each) => each.restarts ?? "–"],
  ["#Since", (each) => ago(each.since)],
  ["Started by", (each) => (each.pid ? (each.own ? "this resource" : "another program") : "–")],
];

// The nodes that a resource describes, with their processes as far as its module tells them.
function Processes({ state, nodes, processes: told = [], peer }) {
  const known = section(state, "nodes");
  const processes = new Map(told.map((each) => [each.node, each]));
  const list = nodes.map((each) => ({
    state: nodeKey(peer, each.name) in known ? "running" : "not there",
    ...each,
    node: each.name,
    ...processes.get(each.name),
  }));
  const more = told.filter((each) => !nodes.some((one) => one.name === each.node));
  return html`<${Table}
    caption="Nodes and processes"
    columns=${PROCESSES}
    about=${{ peer }}
    list=${[...list, ...more.map((each) => ({ ...each, name: each.node }))]}
    empty="It has no nodes."
  />`;
}
