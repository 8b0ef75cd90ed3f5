// All nodes, and one of them: its module, topics, services, connections and log lines.

import { html, useState } from "../markup.js";
import { count, hertz } from "../format.js";
import { entries, section } from "../state.js";
import { Facts, Failure, Gone, Mark, Page, Panel, Select, Text } from "../parts.js";
import { Table, useFilter } from "../lists.js";
import { Link, ModuleLink, NodeLink, nodeName } from "../links.js";
import { Question, useAnswer, useAsk } from "../asking.js";
import { Lines, Missing, useLog } from "../loglines.js";
import { useTypes } from "./services.js";

const NODE_PERIOD = 5; // seconds after which the node that is shown is asked again

// Where the module is clear it is left out.
const COLUMNS = [
  [
    "Node",
    ([name, node]) =>
      html`<${NodeLink} name=${name} />${node.problem &&
        html`<div class="muted"><${Mark} state="WARN" word="" />${node.problem}</div>`}`,
  ],
  ["Module", ([, node], { own }) => html`<${ModuleLink} name=${node.module || own} />`],
  ["#Publishes", ([, node]) => node.publishes || 0],
  ["#Subscribes", ([, node]) => node.subscribes || 0],
  ["#Services", ([, node]) => node.serves || 0],
];
export const NODE_COLUMNS = COLUMNS.filter(([heading]) => heading !== "Module");

export function Nodes({ state }) {
  const filter = useFilter("name or module");
  const own = section(state, "agent").name;
  const all = entries(state, "nodes");
  const shown = all.filter(([name, one]) => filter.matches(`${nodeName(name)} ${name} ${one.module || own}`));
  const hidden = section(state, "hidden").nodes;
  return html`<${Page} title="Nodes" kind=${`${all.length} in all modules`}>
    ${filter.field}
    <${Panel}
      ><${Table} caption="Nodes" columns=${COLUMNS} about=${{ own }} empty="No node matches." list=${shown} />
      <p class="empty">
        ${hidden ? `The server leaves out ${hidden} further nodes. ` : ""}Of peers, the nodes that offer something to
        this module.
      </p><//
    ><//
  >`;
}

export function NodePage({ name, state, connection }) {
  const own = section(state, "agent").name;
  const at = name.indexOf(":");
  const peer = at > 0 ? name.slice(0, at) : "",
    node = name.slice(at + 1);
  const known = section(state, "nodes")[name];
  const detail = section(section(state, "detail"), `node:${name}`);
  const { value: facts, failure } = useAnswer(connection, "node", { name: node, peer }, NODE_PERIOD);
  const typeOf = useTypes(connection, state);
  const topics = section(state, "topics");
  // What its own module knows is more: a node of a peer has topics that do not cross.
  const list = (kind, told) => [...new Set([...(detail[kind] || []), ...(told || [])])].sort();
  const publishes = list("publishes", facts && Object.keys(facts.publications)),
    subscribes = list("subscribes", facts && Object.keys(facts.subscriptions));
  const services = list("services", facts && facts.services.map((each) => (peer ? `${peer}:${each}` : each)));
  if (!known && !facts)
    return html`<${Page} title=${nodeName(name)} kind=${`Node of ${peer || own}`}
      >${failure ? html`<${Failure} failure=${failure} />` : html`<${Gone} kind="node" name=${name} />`}<//
    >`;
  const problem = detail.problem || facts?.problem;
  return html`<${Page}
    title=${nodeName(name)}
    kind=${html`Node ${peer && html`<code>${node}</code> `}of <${ModuleLink} name=${peer || own} />`}
    aside=${facts &&
    html`<${Mark} state=${facts.problem ? "ERROR" : "OK"} word=${facts.problem ? "does not answer" : "answers"} />`}
    ><div class="grid">
      <${Panel} title="Node"
        ><${Facts}
          rows=${[
            ["Module", html`<${ModuleLink} name=${peer || own} />`],
            ["Process", facts?.pid],
            ["Address of its API", facts && html`<code>${facts.uri}</code>`],
            ["Publishes", count(publishes.length)],
            ["Subscribes", facts || !peer ? count(subscribes.length) : undefined],
            ["Services", count(services.length)],
          ]}
        />
        ${problem && html`<p class="failure">${problem}</p>`}
        ${failure && html`<p class="empty">The node cannot be asked: ${failure.error}. ${failure.remedy}</p>`}<//
      >
      <${Panel} title="Services"
        ><${Table}
          caption="Services"
          columns=${[
            [
              "Service",
              ([each, service]) =>
                service
                  ? html`<${Link} page="service" name=${each}>${service.name}<//>`
                  : html`<span class="mono">${each.slice(each.indexOf(":") + 1)}</span>`,
            ],
            ["~Type", ([, service]) => (service ? typeOf(service) : "not known here")],
          ]}
          empty="It offers no service."
          list=${services.map((each) => [each, section(state, "services")[each]])}
      /><//>
      ${[
        ["Publishes", publishes, facts?.publications, "It publishes nothing."],
        [
          "Subscribes",
          subscribes,
          facts?.subscriptions,
          peer && !facts ? "Not known: only its own module knows what it subscribes to." : "It subscribes to nothing.",
        ],
      ].map(
        ([title, names, types, empty]) =>
          html`<${Panel} key=${title} title=${title}>
            <${Table}
              caption=${title}
              columns=${[
                [
                  "Topic",
                  (each) =>
                    topics[each]
                      ? html`<${Link} page="topic" name=${each} />`
                      : html`<span class="mono">${each}</span>`,
                ],
                ["~Type", (each) => topics[each]?.type || types?.[each] || ""],
                [
                  "#Rate",
                  (each) => (topics[each] ? hertz(topics[each].rate) : html`<span class="muted">not known here</span>`),
                ],
              ]}
              empty=${empty}
              list=${names}
          /><//>`,
      )}
      <${Connections} facts=${facts} failure=${failure} module=${peer || own} own=${own} />
      <${Levels} node=${node} peer=${peer} connection=${connection} />
      <${NodeLog} node=${node} module=${peer || own} own=${own} connection=${connection} /></div
  ><//>`;
}

// The agent of a module is a node of its graph: it takes messages to and from peers.
const OtherEnd = ({ name, module, own }) =>
  name === "/rmpa" || name.endsWith(":/rmpa")
    ? html`the agent of <${ModuleLink} name=${module} />`
    : name.includes("://")
      ? html`<code>${name}</code>`
      : html`<${NodeLink} name=${name.startsWith(`${own}:`) ? name.slice(own.length + 1) : name} />`;

const CONNECTIONS = [
  ["Topic", (one) => html`<${Link} page="topic" name=${one.topic} />`],
  ["~Way", (one) => (one.inbound ? "← from" : "→ to")],
  ["Other end", (one, about) => html`<${OtherEnd} name=${one.other} ...${about} />`],
  [
    "State",
    ({ connected }) =>
      html`<${Mark} state=${connected ? "up" : "silent"} word=${connected ? "connected" : "not connected"} />`,
  ],
];
const Connections = ({ facts, failure, module, own }) =>
  html`<${Panel} title="Connections" wide
    >${facts && !facts.connections
      ? html`<p class="empty">
          ${facts.problem
            ? "Not known: the node does not answer."
            : "Not reported by this peer: its agent is of an earlier release."}
        </p>`
      : html`<${Table}
          caption="Connections"
          columns=${CONNECTIONS}
          about=${{ module, own }}
          empty=${facts ? "It has no connection." : failure ? "Not known: the node cannot be asked." : "Asking …"}
          list=${facts?.connections || []}
        />`}<//
  >`;

const LOG_LEVELS = ["debug", "info", "warn", "error", "fatal"];

const LOGGERS = [
  ["Logger", ([name]) => html`<span class="mono">${name}</span>`],
  ["Level", ([, level]) => level],
];

// The loggers of a node are asked for by a button: the roscpp of some systems does not bear the question.
function Levels({ node, peer, connection }) {
  const [logger, setLogger] = useState("");
  const [level, setLevel] = useState("info");
  const [state, ask] = useAsk(connection, (told) => ({ said: `${Object.keys(told).join(" and ")}: ${level}` }));
  const submit = (event) => {
    event.preventDefault();
    ask("set_log_level", { name: node, peer, logger: logger.trim(), level });
  };
  return html`<${Panel} title="Log levels"
    >${connection.hello.may.includes("control") &&
    html`<form class="row" onSubmit=${submit}>
      <${Text} label="Logger" value=${logger} placeholder="of its own code" onInput=${setLogger} />
      <${Select} label="Level" value=${level} names=${LOG_LEVELS} onChange=${setLevel} />
      <button class="primary" disabled=${state.waits}>Set</button>
      <span role="status" class="muted said">${state.said}</span><${Failure} failure=${state.failure} />
    </form>`}
    <${Question}
      connection=${connection}
      what="log_levels"
      args=${{ name: node, peer }}
      label="Show its loggers"
      show=${(levels) =>
        html`<${Table} caption="Loggers" columns=${LOGGERS} empty="None." list=${Object.entries(levels).sort()} />`}
  /><//>`;
}

function NodeLog({ node, module, own, connection }) {
  const log = useLog(connection, { modules: [module], node, level: "debug" });
  return html`<${Panel} title="Log" wide
    ><${Missing} log=${log} /><${Lines}
      lines=${log.lines.slice(0, 100)}
      empty=${log.waits ? "Asking …" : "Its module keeps no line of it."}
      own=${own}
      bare=${true}
  /><//>`;
}
