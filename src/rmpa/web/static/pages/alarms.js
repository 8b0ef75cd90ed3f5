// Alarms that stand.

import { html } from "../markup.js";
import { entries } from "../state.js";
import { Mark, Page, Panel, Since } from "../parts.js";
import { Table } from "../lists.js";
import { Link } from "../links.js";
import { Concerns } from "../mandala.js";

const COLUMNS = [
  ["Resource", ([, alarm]) => html`<${Link} page="resource" name=${alarm.resource} />`],
  ["Level", ([, alarm]) => html`<${Mark} state=${alarm.level} />`],
  ["Says", ([, alarm]) => alarm.text],
  ["Stands for", ([, alarm]) => html`<${Since} moment=${alarm.at} />`],
];

export function Alarms({ state, connection }) {
  const alarms = entries(state, "alarms");
  return html`<${Page}
    title="Alarms"
    kind=${alarms.length ? `${alarms.length} ${alarms.length > 1 ? "stand" : "stands"}` : "None stands"}
  >
    <div class="grid">
      <${Panel} title="Alarms of Smart Resources" wide
        ><${Table} caption="Alarms" columns=${COLUMNS} empty="There is no alarm." list=${alarms}
      /><//>
      <${Panel} title="All that is wrong"><${Concerns} state=${state} connection=${connection} /><//></div
  ><//>`;
}
