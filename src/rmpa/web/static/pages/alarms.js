// Alarms that stand, and those of before.

import { html, useEffect, useState } from "../markup.js";
import { clock } from "../format.js";
import { entries } from "../state.js";
import { Failure, Link, Mark, Page, Panel, Since, Table } from "../parts.js";
import { Concerns } from "../mandala.js";

export function Alarms({ state, connection }) {
  const alarms = entries(state, "alarms");
  const [history, setHistory] = useState(null);
  const [failure, setFailure] = useState(null);
  const open = connection.phase === "open"; // without it, what was read stays
  useEffect(() => {
    if (open) connection.ask("history").then((value) => { setHistory(value); setFailure(null); }, setFailure);
  }, [alarms.map(([id, each]) => id + each.level).join(), state.recorded, open]);
  return html`<${Page} title="Alarms" kind=${alarms.length ? `${alarms.length} ${alarms.length > 1 ? "stand" : "stands"}` : "None stands"}>
    <div class="grid"><${Panel} title="Alarms of Smart Resources" wide><${Table} caption="Alarms" columns=${["Resource", "Level", "Says", "Stands for"]} empty="No alarm stands." list=${alarms}>
      ${([id, alarm]) => html`<tr key=${id}><th scope="row"><${Link} page="resource" name=${alarm.resource} /></th><td><${Mark} state=${alarm.level} /></td><td>${alarm.text}</td><td><${Since} moment=${alarm.at} /></td></tr>`}<//><//>
    <${Panel} title="All that is wrong"><${Concerns} state=${state} connection=${connection} /><//>
    <${Panel} title="History"><${Failure} failure=${failure} />${history && html`<${Table} caption="History of alarms" columns=${["Time", "Level", "Resource or module", "Says"]} empty="Nothing has happened since rmpa web started.">${[...history].reverse().map((each, at) => html`<tr key=${at}><th scope="row">${clock(each.at)}</th><td><${Mark} state=${each.level} /></td><td><${Link} page=${each.resource ? "resource" : "module"} name=${each.resource || each.module} /></td><td>${each.text}</td></tr>`)}<//>`}<//></div><//>`;
}
