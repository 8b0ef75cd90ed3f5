// The processes of the nodes of all modules, the busiest first; asked for only while the page is open.

import { html } from "../markup.js";
import { bytes, percent } from "../format.js";
import { Failure, Mark, Page, Panel, Since } from "../parts.js";
import { Table, sorted, useFilter } from "../lists.js";
import { ModuleLink, NodeLink, nodeKey } from "../links.js";
import { useAnswer } from "../asking.js";
import { section } from "../state.js";

const PERIOD = 2; // seconds
const COLUMNS = [
  ["Node", (one) => html`<${NodeLink} name=${nodeKey(one.peer, one.node)}>${one.node}<//>`, (one) => one.node],
  ["Module", (one) => html`<${ModuleLink} name=${one.module} />`, (one) => one.module],
  ["#CPU", (one) => (one.pid ? percent(100 * one.cpu) : "–"), (one) => one.pid && one.cpu],
  ["#Memory", (one) => (one.pid ? bytes(one.rss) : "–"), (one) => one.pid && one.rss],
  ["#Threads", (one) => one.threads || "–", (one) => one.threads || undefined],
  ["#PID", (one) => one.pid || "–", (one) => one.pid],
  ["#Since", (one) => (one.since ? html`<${Since} moment=${one.since} />` : "–"), (one) => one.since || undefined],
  ["Started by", (one) => one.started_by || "–", (one) => one.started_by],
];

export function Top({ state, connection }) {
  const own = section(state, "agent").name;
  const answer = useAnswer(connection, "top", {}, PERIOD);
  const filter = useFilter("node or module");
  const told = Object.entries(answer.last || {});
  const all = told.flatMap(([module, processes]) =>
    Array.isArray(processes)
      ? processes.map((one) => ({ ...one, module, peer: module === own ? "" : module, name: `${module}:${one.node}` }))
      : [],
  );
  const problems = told.filter(([, processes]) => !Array.isArray(processes));
  const shown = all.filter((one) => filter.matches(`${one.node} ${one.module}`));
  const total = percent(100 * all.reduce((sum, one) => sum + (one.cpu || 0), 0));
  return html`<${Page}
    title="Top"
    kind=${`${all.length} nodes of ${told.length - problems.length} modules: ${total} of a core`}
  >
    ${filter.field}
    <${Panel}
      ><${Failure} failure=${answer.failure} />
      ${problems.map(
        ([module, why]) => html`<p class="missing" key=${module}><${Mark} state="WARN" word="" />${module}: ${why}</p>`,
      )}
      <${Table}
        caption="Top"
        columns=${COLUMNS}
        list=${sorted(shown, (one) => one.cpu, true)}
        empty=${answer.value || answer.failure ? "No node runs." : "Asking …"} /><//
  ><//>`;
}
