// A module: its link, its clock, what it offers, and what of it is hidden or dropped.

import { html } from "../markup.js";
import { bandwidth, bounded, bytes, count, duration, percent, seconds } from "../format.js";
import { entries, section } from "../state.js";
import { Facts, Gone, Mark, Page, Panel, Since, under } from "../parts.js";
import { Table } from "../lists.js";
import { Link } from "../links.js";
import { Why, useAnswer } from "../asking.js";
import { NODE_COLUMNS } from "./nodes.js";
import { TopicTable, isData } from "./topics.js";
import { costs } from "../mandala.js";
import { Lines } from "../plot.js";
import { Lines as LogLines, Missing, useLog } from "../loglines.js";

const DIRECTIONS = [
  ["bytes_in", "received"],
  ["bytes_out", "sent"],
];

const RESOURCES = [
  ["Resource", ([key, one]) => html`<${Link} page="resource" name=${key}>${one.name}<//>`],
  ["Quality", ([, one]) => html`<${Mark} state=${one.level} />`],
  ["Profile", ([, one]) => one.profile || "none"],
  ["Says", ([, one]) => one.message],
];

export function ModulePage({ name, state, connection }) {
  const module = section(state, "modules")[name];
  if (!module) return html`<${Page} title=${name} kind="Module"><${Gone} kind="module" name=${name} /><//>`;
  const own = section(state, "agent").name === name;
  const detail = section(section(state, "detail"), `module:${name}`);
  const all = entries(state, "topics").filter(([, one]) => [...(one.from || []), ...(one.to || [])].includes(name));
  const topics = all.filter(([topic]) => isData(topic, state));
  const resources = entries(state, "resources").filter(([, one]) => one.module === name);
  const nodes = entries(state, "nodes").filter(([, one]) => (one.module || section(state, "agent").name) === name);
  return html`<${Page} title=${name} kind="Module" aside=${html`<${Mark} state=${module.state} />`}
    ><div class="grid">
      ${own
        ? html`<${Agent} agent=${section(state, "agent")} detail=${detail} />`
        : html`<${LinkPanel} module=${module} detail=${detail} />`}
      ${!own &&
      html`<${PeerAgent}
          ...${{ name, connection }}
          up=${module.state === "up" || module.state === "silent"}
          version=${section(state, "agent").version}
        />
        <${Panel} title="Lanes"><${Lanes} lanes=${section(detail, "link").lanes} linked=${Boolean(detail.link)} /><//>
        <${Panel} title="Way to it"><${Why} connection=${connection} kind="module" name=${name} /><//>`}
      ${(module.error || (module.hidden || []).length > 0) &&
      html`<${Panel} title="What is wrong">
        ${module.error && html`<p class="failure">${module.error}</p>`}
        ${module.lost && html`<p class="failure">${costs(module.lost).slice(2)}</p>`}
        ${(module.hidden || []).map((text) => html`<p class="failure" key=${text}>${text}</p>`)}<//
      >`}
      ${!own &&
      html`<${Panel} title="Bytes a second on the link" wide
        ><${Lines}
          label="Bytes a second"
          series=${DIRECTIONS.map(([key, text]) => ({ label: text, value: module[key] }))}
          format=${bandwidth}
      /><//>`}
      ${resources.length > 0 &&
      html`<${Panel} title="Smart Resources"
        ><${Table} caption="Smart Resources" columns=${RESOURCES} list=${resources}
      /><//>`}
      ${nodes.length > 0 &&
      html`<${Panel} title=${`Nodes of ${name}`}
        ><${Table} caption="Nodes" columns=${NODE_COLUMNS} list=${nodes}
      /><//>`}
      ${own && html`<${Counters} state=${state} connection=${connection} />`}
      <${Panel} title=${`Topics of ${name}`} wide
        ><${TopicTable} list=${topics} empty="It has no topic." /> ${all.length > topics.length &&
        html`<details>
          <summary>${all.length - topics.length} of its Smart Resources, about themselves, and of the log</summary>
          <${TopicTable} list=${all.filter(([topic]) => !isData(topic, state))} />
        </details>`}<//
      >
      <${ModuleLog} name=${name} own=${section(state, "agent").name} connection=${connection} /></div
  ><//>`;
}

function ModuleLog({ name, own, connection }) {
  const log = useLog(connection, { modules: [name], level: "info" });
  return html`<${Panel} title=${`Log of ${name}`} wide
    ><${Missing} log=${log} /><${LogLines}
      lines=${log.lines.slice(0, 50)}
      empty=${log.waits ? "Asking …" : "There is no line."}
      own=${own}
  /><//>`;
}

const LinkPanel = ({ module, detail }) => {
  const link = section(detail, "link");
  return html`<${Panel} title="Link"
    ><${Facts}
      rows=${[
        ["State", html`<${Mark} state=${module.state} />`],
        ["For", module.since && html`<${Since} moment=${module.since} />`],
        ["Address", module.remote],
        ["Round trip", seconds(module.rtt)],
        ["Clock offset", bounded(module.offset, module.offset_error)],
        ["In", bandwidth(module.bytes_in)],
        ["Out", bandwidth(module.bytes_out)],
        ["Waiting to be sent", module.queued ? bytes(module.queued) : undefined],
        ["Dropped, link too slow", module.dropped ? count(module.dropped) : undefined],
        ["Topics that it offers", count(module.topics_in)],
        ["Topics offered to it", count(module.topics_out)],
        ["Direct subscribers here", module.direct_in || undefined],
        ["Direct subscribers there", module.direct_out || undefined],
        ["Relayed by", module.via],
        ["Found by", module.source],
        ["Dialled by", link.dialled === undefined ? undefined : link.dialled ? "this module" : "the peer"],
        ["Next attempt in", detail.next_attempt !== undefined ? seconds(detail.next_attempt) : undefined],
        ["GUID", module.guid ? html`<code>${module.guid}</code>` : ""],
      ]}
  /><//>`;
};

// What is shown of a module, this one or a peer, of what its agent tells: a title, and the fact.
const MODULE_FACTS = [
  ["Host", (module) => module.host],
  ["System", (module) => module.system],
  ["CPU", (module) => module.cpu !== undefined && html`${percent(module.cpu)} of a core`],
  ["Memory", (module) => module.rss !== undefined && bytes(module.rss)],
  ["Open files", (module) => module.files_limit && `${count(module.files_open)} of ${count(module.files_limit)}`],
  ["Proxies", (module) => count(module.proxies)],
  ["Core", (module) => html`<code>${module.core_uri}</code>`],
];
const moduleFacts = (module) => MODULE_FACTS.map(([title, shown]) => [title, shown(module) || undefined]);

const PEER_PERIOD = 2; // seconds between two questions to a peer's agent while its page is open

// What a peer's agent tells of itself. One of an earlier release does not know the question.
function PeerAgent({ name, up, connection, version }) {
  const { value, failure } = useAnswer(connection, "agent", { peer: name }, PEER_PERIOD, String(up));
  return html`<${Panel} title="Agent"
    >${value
      ? html`<${Facts}
          rows=${[
            [
              "Version",
              value.version === version
                ? value.version
                : html`<${Mark} state="WARN" word=${`${value.version || "unknown"}, here ${version}`} />`,
            ],
            ["Runs for", duration(value.uptime)],
            ...moduleFacts(value),
          ]}
        />`
      : html`<p class="empty">
          ${!failure
            ? "Asking …"
            : !up
              ? "Not known without a link."
              : `Version and CPU are not reported by this peer: ${failure.error}`}
        </p>`}<//
  >`;
}

const PURPOSE = { express: "control, small messages", bulk: "large messages" };
const laneState = (lane) =>
  lane.connected ? ["up", "connected"] : lane.unneeded ? ["away", "not needed now"] : ["linking", "no connection"];
const LANES = [
  ["Lane", (lane) => under(lane.name, PURPOSE[lane.name])],
  ["State", (lane) => html`<${Mark} state=${laneState(lane)[0]} word=${laneState(lane)[1]} />`],
  ["#In", (lane) => bytes(lane.bytes_in)],
  ["#Out", (lane) => bytes(lane.bytes_out)],
  ["#Waiting", (lane) => bytes(lane.queued || undefined)],
  ["#Dropped", (lane) => count(lane.dropped)],
];
const Lanes = ({ lanes = [], linked }) =>
  linked && !lanes.length
    ? html`<p class="empty">The agent does not report lanes.</p>`
    : html`<${Table} caption="Lanes" columns=${LANES} empty="It has no link." list=${lanes} />`;

const Agent = ({ agent, detail }) =>
  html`<${Panel} title="Agent"
    ><${Facts}
      rows=${[
        ["Version", agent.version],
        ["Runs for", html`<${Since} moment=${agent.started} />`],
        ...moduleFacts(agent),
        ["Domain", agent.domain],
        ["Addresses", (agent.addresses || []).join(", ")],
        ["Settings", agent.config_file],
        ["Process", agent.pid],
        ["Core's memory", agent.core_memory],
        ["Connections of vanished hosts", detail.end_connections || undefined],
        ["Real time", (agent.realtime || []).join("; ")],
        ["GUID", html`<code>${agent.guid}</code>`],
      ]}
    />
    ${agent.files_problem && html`<p class="failure">${agent.files_problem}</p>`}<//
  >`;

const COUNTERS = [
  ["Reason", ([name]) => html`<code>${name}</code>`],
  ["#Count", ([, value]) => count(value)],
];
const Counters = ({ state, connection }) => {
  const counters = entries(section(state, "detail"), "counters:");
  connection.look([...new Map([...connection.looks, ["counters", ""]].map((each) => [each.join(), each])).values()]);
  return html`<${Panel} title="Counted by the agent"
    ><${Table} caption="Counters" columns=${COUNTERS} list=${counters}
  /><//>`;
};
