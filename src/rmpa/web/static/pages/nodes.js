// All nodes, and one of them: its module, topics, services, connections and log lines.

import { html, useState } from "../markup.js";
import { count, hertz } from "../format.js";
import { entries, section } from "../state.js";
import {
  Facts,
  Failure,
  Gone,
  Link,
  Mark,
  ModuleLink,
  NodeLink,
  nodeName,
  Page,
  Panel,
  Question,
  Table,
  memo,
  useAnswer,
  useFilter,
} from "../parts.js";
import { Lines, Missing, useLog } from "../loglines.js";
import { useTypes } from "./services.js";

const NODE_PERIOD = 5; // seconds after which the node that is shown is asked again

export const NodeRow = memo(
  ({ name, node, own }) =>
    html`<tr>
      <th scope="row">
        <${NodeLink} name=${name} />${node.problem &&
        html`<div class="muted"><${Mark} state="WARN" word="" />${node.problem}</div>`}
      </th>
      ${own && html`<td><${ModuleLink} name=${node.module || own} /></td>`}
      <td class="number">${node.publishes || 0}</td>
      <td class="number">${node.subscribes || 0}</td>
      <td class="number">${node.serves || 0}</td>
    </tr>`,
);
// Where the module is clear; `own` is left out then.
export const NODE_COLUMNS = ["Node", "#Publishes", "#Subscribes", "#Services"];

export function Nodes({ state }) {
  const filter = useFilter("name or module");
  const own = section(state, "agent").name;
  const all = entries(state, "nodes");
  const shown = all.filter(([name, one]) => filter.matches(`${nodeName(name)} ${name} ${one.module || own}`));
  const hidden = section(state, "hidden").nodes;
  return html`<${Page} title="Nodes" kind=${`${all.length} in all modules`}>
    ${filter.field}
    <${Panel}
      ><${Table}
        caption="Nodes"
        columns=${["Node", "Module", ...NODE_COLUMNS.slice(1)]}
        empty="No node matches."
        list=${shown}
      >
        ${([name, one]) => html`<${NodeRow} key=${name} name=${name} node=${one} own=${own} />`}<//
      >
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
        ><${Table} caption="Services" columns=${["Service", "Type"]} empty="It offers no service." list=${services}
          >${(each) => {
            const service = section(state, "services")[each];
            return html`<tr key=${each}>
              <th scope="row">
                ${service
                  ? html`<${Link} page="service" name=${each}>${service.name}<//>`
                  : html`<span class="mono">${each.slice(each.indexOf(":") + 1)}</span>`}
              </th>
              <td class="muted">${service ? typeOf(service) : "not known here"}</td>
            </tr>`;
          }}<//
        ><//
      >
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
            <${Table} caption=${title} columns=${["Topic", "Type", "#Rate"]} empty=${empty} list=${names}
              >${(each) =>
                html`<tr key=${each}>
                  <th scope="row">
                    ${topics[each]
                      ? html`<${Link} page="topic" name=${each} />`
                      : html`<span class="mono">${each}</span>`}
                  </th>
                  <td class="muted">${topics[each]?.type || types?.[each] || ""}</td>
                  <td class="number">
                    ${topics[each] ? hertz(topics[each].rate) : html`<span class="muted">not known here</span>`}
                  </td>
                </tr>`}<//
            ><//
          >`,
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
          columns=${["Topic", "Way", "Other end", "State"]}
          empty=${facts ? "It has no connection." : failure ? "Not known: the node cannot be asked." : "Asking …"}
          list=${facts?.connections || []}
          >${(one, at) =>
            html`<tr key=${at}>
              <th scope="row"><${Link} page="topic" name=${one.topic} /></th>
              <td class="muted">${one.inbound ? "← from" : "→ to"}</td>
              <td><${OtherEnd} name=${one.other} module=${module} own=${own} /></td>
              <td>
                <${Mark}
                  state=${one.connected ? "up" : "silent"}
                  word=${one.connected ? "connected" : "not connected"}
                />
              </td>
            </tr>`}<//
        >`}<//
  >`;

const LOG_LEVELS = ["debug", "info", "warn", "error", "fatal"];

// The loggers of a node are asked for by a button: the roscpp of some systems does not bear the question.
function Levels({ node, peer, connection }) {
  const [logger, setLogger] = useState("");
  const [level, setLevel] = useState("info");
  const [state, set] = useState({});
  const submit = (event) => {
    event.preventDefault();
    set({ waits: true });
    connection.ask("set_log_level", { name: node, peer, logger: logger.trim(), level }).then(
      (told) => set({ said: `${Object.keys(told).join(" and ")}: ${level}` }),
      (failure) => set({ failure }),
    );
  };
  return html`<${Panel} title="Log levels"
    >${connection.hello.may.includes("control") &&
    html`<form class="row" onSubmit=${submit}>
      <label
        ><span>Logger</span
        ><input value=${logger} placeholder="of its own code" onInput=${(event) => setLogger(event.target.value)}
      /></label>
      <label
        ><span>Level</span
        ><select value=${level} onChange=${(event) => setLevel(event.target.value)}>
          ${LOG_LEVELS.map((each) => html`<option key=${each} value=${each}>${each}</option>`)}
        </select></label
      >
      <button class="primary" disabled=${state.waits}>Set</button>
      <span role="status" class="muted said">${state.said}</span><${Failure} failure=${state.failure} />
    </form>`}
    <${Question}
      connection=${connection}
      what="log_levels"
      args=${{ name: node, peer }}
      label="Show its loggers"
      show=${(levels) =>
        html`<${Table}
          caption="Loggers"
          columns=${["Logger", "Level"]}
          empty="None."
          list=${Object.entries(levels).sort()}
          >${([name, each]) =>
            html`<tr key=${name}>
              <th scope="row" class="mono">${name}</th>
              <td>${each}</td>
            </tr>`}<//
        >`}
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
