// The log of all nodes of this module, /rosout, newest first.

import { html, useState } from "../markup.js";
import { section } from "../state.js";
import { Choice, Page, Panel, useFilter, useKept } from "../parts.js";
import { Lines, useLog } from "../loglines.js";

const LEVELS = [
  ["DEBUG", "All"],
  ["INFO", "Info"],
  ["WARN", "Warnings"],
  ["ERROR", "Errors"],
];
const RANK = { DEBUG: 0, INFO: 1, WARN: 2, ERROR: 3, FATAL: 4 };

export function Log({ state, connection }) {
  const [level, setLevel] = useKept("level", "INFO");
  const filter = useFilter("text or node");
  const [held, hold] = useState(false);
  const own = section(state, "agent").name;
  const lines = useLog(connection, held);
  const shown = lines.filter((line) => RANK[line.level] >= RANK[level] && filter.matches(`${line.node} ${line.text}`));
  return html`<${Page}
    title="Log"
    kind=${`Of the nodes of ${own}, newest first. The log of other modules stays there: their own rmpa web shows it.`}
    aside=${html`<button type="button" aria-pressed=${String(held)} onClick=${() => hold(!held)}>
      ${held ? "Go on" : "Hold"}
    </button>`}
  >
    <div class="row filter-row">
      <${Choice} label="Least level" value=${level} onChoose=${setLevel} options=${LEVELS} />${filter.field}
    </div>
    <${Panel}
      ><${Lines}
        lines=${shown}
        empty=${lines.length
          ? `No line is like that; ${lines.length} others are hidden.`
          : "No node of this module has written a line since rmpa web started."} /><//
  ><//>`;
}
