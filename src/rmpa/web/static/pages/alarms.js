// Alarms that stand.

import { html } from "../markup.js";
import { entries } from "../state.js";
import { Link, Mark, Page, Panel, Since, Table } from "../parts.js";
import { Concerns } from "../mandala.js";

export function Alarms({ state, connection }) {
  const alarms = entries(state, "alarms");
  return html`<${Page}
    title="Alarms"
    kind=${alarms.length ? `${alarms.length} ${alarms.length > 1 ? "stand" : "stands"}` : "None stands"}
  >
    <div class="grid">
      <${Panel} title="Alarms of Smart Resources" wide
        ><${Table}
          caption="Alarms"
          columns=${["Resource", "Level", "Says", "Stands for"]}
          empty="There is no alarm."
          list=${alarms}
        >
          ${([id, alarm]) =>
            html`<tr key=${id}>
              <th scope="row"><${Link} page="resource" name=${alarm.resource} /></th>
              <td><${Mark} state=${alarm.level} /></td>
              <td>${alarm.text}</td>
              <td><${Since} moment=${alarm.at} /></td>
            </tr>`}<//
        ><//
      >
      <${Panel} title="All that is wrong"><${Concerns} state=${state} connection=${connection} /><//></div
  ><//>`;
}
