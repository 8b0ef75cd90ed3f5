// All services, and one of them: its types, and a call.

import { html, useState } from "../markup.js";
import { count, seconds } from "../format.js";
import { entries, section } from "../state.js";
import { Facts, Failure, Gone, Page, Panel, under } from "../parts.js";
import { Table, useFilter } from "../lists.js";
import { Link, ModuleLink, NodeLink, nodeKey } from "../links.js";
import { Question, Why, useAnswer, useAsk } from "../asking.js";
import { json } from "../typed.js";

const STATES = { home: "stays in its module", hidden: "hidden here", idle: "not in use", open: "in use" };

const ASKING = html`<span class="muted">asking …</span>`,
  UNTOLD = html`<span class="muted">not told by its server</span>`;
// The types that a service's server alone knows: all are asked when a page shows services, and when there are more.
export function useTypes(connection, state) {
  const unknown = entries(state, "services").filter(([, one]) => !one.type && one.state !== "hidden");
  const { value, failure } = useAnswer(connection, "types", {}, 0, String(unknown.length));
  const missing = value || failure ? UNTOLD : ASKING;
  return (one) => one.type || (one.state === "hidden" ? "" : value?.[one.name] || missing);
}

const COLUMNS = [
  ["Service", ([name, one]) => under(html`<${Link} page="service" name=${name}>${one.name}<//>`, one.problem)],
  ["Module", ([, service], { own }) => html`<${ModuleLink} name=${service.module || own} />`],
  ["Node", ([, service]) => html`<${NodeLink} name=${nodeKey(service.module, service.node)} />`],
  ["Type", ([, , type]) => type],
  ["State", ([, service]) => STATES[service.state] || service.state],
  ["#Calls", ([, service]) => count(service.calls || 0)],
  ["#Failed", ([, service]) => count(service.failed || 0)],
];

export function Services({ state, connection }) {
  const typeOf = useTypes(connection, state);
  const filter = useFilter("name or type");
  const all = entries(state, "services");
  const hidden = section(state, "hidden").services;
  const shown = all
    .map(([name, one]) => [name, one, typeOf(one)])
    .filter(([name, , type]) => filter.matches(`${name} ${typeof type === "string" ? type : ""}`));
  return html`<${Page} title="Services" kind=${`${all.length} in all modules`}>
    ${filter.field}
    <${Panel}
      ><${Table}
        caption="Services"
        columns=${COLUMNS}
        about=${{ own: section(state, "agent").name }}
        empty="No service matches."
        list=${shown}
      />
      ${hidden &&
      html`<p class="empty">
        ${count(hidden)} more services are not listed: <code>rmpa service list</code> has them.
      </p>`}<//
    ><//
  >`;
}

export function ServicePage({ name, state, connection }) {
  const detail = section(section(state, "detail"), `service:${name}`);
  const service = section(state, "services")[name];
  if (!service) return html`<${Page} title=${name} kind="Service"><${Gone} kind="service" name=${name} /><//>`;
  const latency = section(detail, "latency");
  return html`<${Page}
    title=${service.name}
    kind=${`Service of ${service.module || section(state, "agent").name}${service.type ? ` · ${service.type}` : ""}`}
    ><div class="grid">
      <${Panel} title="Service"
        ><${Facts}
          rows=${[
            ["Node", html`<${NodeLink} name=${nodeKey(service.module, service.node)} />`],
            ["State", STATES[service.state] || service.state],
            ["Transport", service.transport],
            ["Relayed because", detail.relayed_because],
            ["Address", detail.address],
            ["Calls across the mesh", count(service.calls || 0)],
            ["Failed", service.failed ? count(service.failed) : undefined],
            ["Under way", detail.active || undefined],
            ["Latency, median", latency.p50 !== undefined ? seconds(latency.p50) : undefined],
            ["Latency, 99th percentile", latency.p99 !== undefined ? seconds(latency.p99) : undefined],
            ["Crosses", detail.crosses ? "yes" : "no"],
            ["Because", detail.policy],
            ["MD5 sum", detail.md5 && html`<code>${detail.md5}</code>`],
          ]}
        />
        ${service.problem && html`<p class="failure">${service.problem}</p>`}<//
      >
      <${Panel} title="Way of a call"
        ><${Why} connection=${connection} kind="service" name=${service.name} peer=${service.module}
      /><//>
      <${Panel} title="Types and call" wide
        ><${Question}
          connection=${connection}
          what="describe"
          args=${{ service: service.name, peer: service.module || "" }}
          label="Show its types"
          now=${true}
          show=${(value) => html`<${Call} connection=${connection} service=${service} about=${value} />`}
      /><//></div
  ><//>`;
}

function Call({ connection, service, about }) {
  const [text, setText] = useState(JSON.stringify(about.request ?? {}, null, 2));
  const [state, ask, set] = useAsk(connection, (answer) => ({ answer }));
  const allowed = connection.may("control");
  const field = { value: text, onInput: (event) => setText(event.target.value), disabled: !allowed };
  const call = (event) => {
    event.preventDefault();
    const { value: request, error } = json(text.trim() || "{}");
    if (error) return set({ failure: { error } });
    return ask("call", { service: service.name, peer: service.module || "", request });
  };
  return html`<div class="grid">
    <div>
      <h3>${about.type}</h3>
      <pre class="tree" tabindex="0">${about.text}</pre>
    </div>
    <form class="form" onSubmit=${call}>
      <label>Request as JSON<textarea spellcheck="false" ...${field}></textarea></label>
      <div class="row">
        <button class="primary" disabled=${!allowed || state.waits}>
          ${state.waits ? "Waiting for the response …" : "Call it"}</button
        >${!allowed && html`<span class="muted">This page is read-only: start rmpa web with --control.</span>`}
      </div>
      <div aria-live="polite">
        <${Failure} failure=${state.failure} />${state.answer &&
        html`<p class="muted">Response after ${seconds(state.answer.seconds)}</p>
          <pre class="tree" tabindex="0">${JSON.stringify(state.answer.response, null, 2)}</pre>`}
      </div>
    </form>
  </div>`;
}
