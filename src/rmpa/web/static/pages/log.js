// The log of all modules, of their nodes and agents, newest first.

import { html, useState } from "../markup.js";
import { entries, section } from "../state.js";
import { Choice, Page, Panel, Pick } from "../parts.js";
import { useFilter, useKept } from "../lists.js";
import { Lines, Missing, useLog } from "../loglines.js";

export const LEVELS = [
  ["debug", "All"],
  ["info", "Info"],
  ["warn", "Warnings"],
  ["error", "Errors"],
];

export function Log({ state, connection }) {
  const own = section(state, "agent").name;
  const [level, setLevel] = useKept("level", "info");
  const [module, setModule] = useKept("module", "");
  const [node, setNode] = useKept("node", "");
  const [held, hold] = useState(false);
  const filter = useFilter("text");
  const modules = entries(state, "modules")
    .filter(([, one]) => ["here", "up", "silent"].includes(one.state))
    .map(([name]) => [name]);
  const nodes = new Set(
    entries(state, "nodes")
      .filter(([, one]) => !module || (one.module || own) === module)
      .map(([, one]) => one.name),
  );
  const wanted = { level, node, ...(module ? { modules: [module] } : {}) };
  const log = useLog(connection, wanted, held);
  const shown = log.lines.filter((line) => filter.matches(line.text));
  return html`<${Page}
    title="Log"
    kind=${`Of the nodes and agents of ${module || "all modules"}, newest first, by the clock of ${own}`}
    aside=${html`<button type="button" aria-pressed=${String(held)} onClick=${() => hold(!held)}>
      ${held ? "Go on" : "Hold"}
    </button>`}
  >
    <div class="row filter-row">
      <${Choice} label="Least level" value=${level} onChoose=${setLevel} options=${LEVELS} />
      <${Pick} aria-label="Module" value=${module} names=${[["", "All modules"], ...modules]} onChange=${setModule} />
      <input
        class="filter"
        type="search"
        list="log-nodes"
        placeholder="Node, or a pattern: /arm/*"
        aria-label="Node, or a pattern such as /arm/*"
        value=${node}
        onChange=${(event) => setNode(event.target.value.trim())}
      />
      <datalist id="log-nodes">
        <option value="/rmpa">the agents</option>
        ${[...nodes].sort().map((name) => html`<option key=${name} value=${name} />`)}
      </datalist>
      ${filter.field}
    </div>
    <${Panel}
      ><${Missing} log=${log} /><${Lines}
        lines=${shown}
        own=${own}
        empty=${log.waits
          ? "Asking …"
          : log.lines.length
            ? `No line is like that; ${log.lines.length} others are hidden.`
            : "There is no such line among the last ones that the agents keep."} /><//
  ><//>`;
}
