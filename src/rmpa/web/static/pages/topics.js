// All topics, and one of them: which node sends it to which, how fast, how late, what is lost, and what is in it.

import { html, useState } from "../markup.js";
import { bandwidth, clock, count, hertz, seconds } from "../format.js";
import { entries, section } from "../state.js";
import { Choice, Facts, Failure, Gone, Mark, Page, Panel, Since, under } from "../parts.js";
import { Table, useFilter, useKept } from "../lists.js";
import { Link, NodeLink, NodeLinks, nodeKey } from "../links.js";
import { Why, useAnswer } from "../asking.js";
import { Lines } from "../plot.js";
import { Live } from "../live.js";
import { PublishPanel } from "../publish.js";

const lostOf = (topic) => (topic.lost || 0) + (topic.dropped || 0);

// How a rate was measured where the topic is published; what is not measured says why.
const WAYS = {
  counted: "counted by its publisher",
  sampled: "measured by a short subscription where it is published",
  "no subscriber": "its publisher may work for subscribers only, and is not woken: Live on its page measures it",
};
const Ago = ({ moment }) => html`<${Since} moment=${moment} text=${(shown) => `${shown} ago`} />`;
function Rate({ topic, measured }) {
  if (topic.stopped)
    return html`<span class="muted">${hertz(topic.rate)}</span>
      <div class="muted">stopped <${Ago} moment=${topic.stopped} /></div>`;
  if (!measured) return hertz(topic.rate);
  if (measured.rate === undefined)
    return html`–${" "}<span class="muted" title=${WAYS[measured.how]}>${measured.how}</span>`;
  return html`<span title=${WAYS[measured.how]}>${measured.rate ? hertz(measured.rate) : "none in 2 s"}</span>`;
}

const muted = (text) => html`<span class="muted">${text}</span>`;
// Of entries [name, topic, what was measured].
const TOPIC_COLUMNS = [
  [
    "Topic",
    ([name, topic]) =>
      html`<${Link} page="topic" name=${name} />${topic.problem &&
        html`<div class="muted"><${Mark} state="WARN" word="" />${topic.problem}</div>`}`,
    ([name]) => name,
  ],
  [
    "#Rate",
    ([, topic, measured]) => html`<${Rate} ...${{ topic, measured }} />`,
    ([, topic, measured]) => measured?.rate ?? topic.rate,
  ],
  [
    "#Bytes",
    ([, topic, measured]) => bandwidth(measured?.bandwidth || topic.bandwidth),
    ([, topic, measured]) => measured?.bandwidth ?? topic.bandwidth,
  ],
  ["~Type", ([, topic]) => topic.type, ([, topic]) => topic.type],
  ["#Latency", ([, topic]) => seconds(topic.latency), ([, topic]) => topic.latency],
  ["#Lost", ([, topic]) => count(lostOf(topic) || undefined), ([, topic]) => lostOf(topic) || undefined],
  [
    "^From → to",
    ([, { from = [], to = [], crosses }]) =>
      html`${from.join(", ") || muted("no publisher")}${" → "}${to.join(", ") || muted("no subscriber")}${!crosses &&
      html` ${muted("does not cross")}`}`,
    ([, topic]) => (topic.from || []).join(", "),
  ],
];
export const TopicTable = ({ list, empty }) =>
  html`<${Table}
    caption="Topics"
    columns=${TOPIC_COLUMNS}
    tone=${([, topic]) => (topic.stopped ? "old" : "")}
    ...${{ list, empty }}
  />`;

// What Smart Resources and the log publish about themselves, next to the topics that carry data.
const ABOUT = new RegExp(
  "/(alarms|context|decision|descriptor|observed|parameter_descriptions|parameter_updates|profile|quality|" +
    "requirements|responses|set_context|state)$",
);
export function isData(name, state) {
  if (name === "/rosout" || name === "/rosout_agg") return false;
  const owner = name.replace(ABOUT, "");
  return owner === name || !Object.values(section(state, "resources")).some((one) => one.name === owner);
}

const FILTERS = {
  data: ["Data", (one, name, state) => isData(name, state)],
  flowing: ["Flowing", (one) => one.rate !== undefined && !one.stopped],
  all: ["All", () => true],
  wrong: ["With a problem", (one) => one.problem || one.lost || one.dropped],
};
let lastRates = {}; // until the server has told them again, as after Back, the order stays
export function Topics({ state }) {
  const [which, choose] = useKept("which", "data");
  const filter = useFilter("name or type");
  const all = entries(state, "topics");
  const fits = FILTERS[which === "data" && filter.typed ? "all" : which][1]; // what is typed is looked for among all
  const told = section(section(state, "detail"), "rates:");
  if (Object.keys(told).length) lastRates = told;
  const rates = lastRates;
  const shown = all
    .filter(([name, one]) => fits(one, name, state) && filter.matches(`${name} ${one.type}`))
    .map(([name, one]) => [name, one, rates[name]]);
  const hidden = section(state, "hidden").topics;
  const flowing = all.filter(([, one]) => FILTERS.flowing[1](one)).length;
  return html`<${Page}
    title="Topics"
    kind=${`${flowing} of ${all.length} flow between modules`}
    aside=${html`<${Choice}
      label="Which topics"
      value=${which}
      onChoose=${choose}
      options=${Object.entries(FILTERS).map(([key, [word]]) => [key, word])}
    />`}
  >
    ${filter.field}
    <${Panel}
      ><${TopicTable} empty="No topic matches." list=${shown} /> ${which === "data" &&
      all.length > shown.length &&
      !filter.typed &&
      html`<p class="empty">
        ${all.length - shown.length} topics of the log and of Smart Resources about themselves are left
        out.${" "}<button type="button" onClick=${() => choose("all")}>Show all</button>
      </p>`}
      ${hidden &&
      html`<p class="empty">${count(hidden)} more topics are not listed: <code>rmpa topic list</code> has them.</p>`}<//
    ><//
  >`;
}

const FIGURES = [
  ["rate", "Rate", hertz],
  ["p50", "Latency, median", seconds],
  ["p99", "Latency, 99th percentile", seconds],
  ["jitter", "Jitter", seconds],
  ["bandwidth", "Bytes", bandwidth],
  ["lost", "Lost", count],
];
const LOSSES = ["lost", "expired", "dropped", "oversized", "late"];
const figureOf = (route, key) =>
  key === "p50" || key === "p99"
    ? section(route, "latency")[key]
    : key === "lost"
      ? LOSSES.reduce((sum, each) => sum + (route[each] || 0), 0)
      : route[key];

export function TopicPage({ name, state, connection }) {
  const [figure, setFigure] = useState("rate");
  const detail = section(section(state, "detail"), `topic:${name}`);
  const topic = section(state, "topics")[name];
  if (!topic)
    return html`<${Page} title=${name} kind="Topic"
      ><${Gone} kind="topic" name=${name} /><${Panel} title="Why?"
        ><${Why} connection=${connection} kind="topic" name=${name} /><//
      ><${PublishPanel} ...${{ connection, state }} topic=${name}
    /><//>`;
  const routes = entries(detail, "routes");
  const own = section(state, "agent").name;
  const format = FIGURES.find(([key]) => key === figure)[2];
  const flowing = routes.filter(([, route]) => route.rate !== undefined);
  return html`<${Page} title=${name} kind=${`Topic · ${topic.type || "type not known"}`}
    ><div class="grid">
      ${topic.problem && html`<${Panel} title="What is wrong" wide><p class="failure">${topic.problem}</p><//>`}
      <${Panel} title="Publishers and subscribers"
        ><${Facts}
          rows=${[
            ["Published in", (topic.from || []).join(", ")],
            ["Subscribed in", (topic.to || []).join(", ")],
            [
              `Publishers in ${own}`,
              detail.publishers?.length > 0 && html`<${NodeLinks} names=${detail.publishers} />`,
            ],
            [
              `Subscribers in ${own}`,
              detail.subscribers?.length > 0 && html`<${NodeLinks} names=${detail.subscribers} />`,
            ],
            [
              "Elsewhere",
              detail.remote_subscribers?.length > 0 && html`<${NodeLinks} names=${detail.remote_subscribers} />`,
            ],
            ["Crosses", topic.crosses ? "yes" : "no"],
            ["Because", detail.policy],
            ["MD5 sum", detail.md5 && html`<code>${detail.md5}</code>`],
          ]}
      /><//>
      <${Panel} title="Way of a message"><${Why} connection=${connection} kind="topic" name=${name} /><//>
      <${Live} connection=${connection} topic=${name} type=${topic.type} state=${state} />
      <${PublishPanel} connection=${connection} state=${state} topic=${name} type=${topic.type} />
      ${flowing.length > 0 &&
      html`<${Panel}
        wide
        title="Figures"
        aside=${html`<${Choice}
          label="Figure"
          value=${figure}
          onChoose=${setFigure}
          options=${FIGURES.map(([key, word]) => [key, word])}
        />`}
      >
        <${Lines}
          key=${figure}
          label=${figure}
          format=${format}
          series=${flowing.map(([key, route]) => ({ label: key, value: figureOf(route, figure) }))}
      /><//>`}
      <${Panel} title="Routes" wide
        ><${Table}
          caption="Routes"
          columns=${ROUTES}
          about=${{ own }}
          empty="It has no route to or from a peer."
          list=${routes.flatMap(withSubscribers)}
      /><//>
      <${ContractPanel} connection=${connection} topic=${name} type=${topic.type} own=${own} routes=${routes.length} />
      <${Events} routes=${routes} /></div
  ><//>`;
}

const contract = (route) =>
  Object.entries(route.contract || {})
    .map(([key, value]) => `${key} ${value}`)
    .join(", ");
const eventsOf = (route) =>
  Object.entries(route.events || {}).map(([kind, times]) => `${kind.replaceAll("_", " ")}: ${count(times)}`);
const ROUTES = [
  [
    "Source",
    (one, { own }) => {
      if (one.inner) return html`<span class="inner mono">→ ${one.node}</span>`;
      const [peer, way] = one.direction === "in" ? [one.peer, [one.peer, own]] : ["", [own, one.peer]];
      return under(html`<${NodeLink} name=${nodeKey(peer, one.node)} />`, way.join(" → "));
    },
  ],
  [
    "State",
    (one) =>
      under(
        one.state,
        one.stopped && html`<${Mark} state="STALE" word="stopped" />${" "}<${Ago} moment=${one.stopped} />`,
        one.problem,
      ),
  ],
  [
    "#Rate",
    (one) =>
      under(
        html`<span class=${one.stopped ? "muted" : ""}>${hertz(one.rate)}</span>`,
        !one.inner && bandwidth(one.bandwidth),
      ),
  ],
  ["#Jitter p99", (one) => seconds(one.jitter)],
  [
    "#Latency p50, p99",
    ({ inner, latency = {} }) =>
      inner ? "–" : under(`${seconds(latency.p50)}, ${seconds(latency.p99)}`, `± ${seconds(latency.error)}`),
  ],
  [
    "#Lost",
    (one) =>
      one.inner
        ? "–"
        : `${one.events?.loss_unknown ? "unknown, ≥ " : ""}${count((one.lost || 0) + (one.expired || 0))}`,
  ],
  ["#Dropped", (one) => (one.inner ? "–" : count((one.dropped || 0) + (one.oversized || 0)))],
  ["Transport", (one) => under(one.transport || "–", one.lane && `${one.lane} lane`, one.condition_text, one.endpoint)],
  ["Contract", (one) => (one.inner ? one.wanted || "" : under(contract(one) || "default", ...eventsOf(one)))],
];

// The subscribers of a route stand below it where their transport is known: the agents see no message of direct ones.
const withSubscribers = ([key, route]) => [
  { ...route, name: key },
  ...(route.subscribers || []).map((one) => ({
    ...one,
    inner: true,
    name: `${key} ${one.node}`,
    problem: troubleOf(one),
  })),
];
function troubleOf(one) {
  const gap = `interrupted ${count(one.interruptions)} times, the last for ${seconds(one.interrupted)}`;
  const parts = [
    one.condition && one.text,
    one.transport === "direct" && "not measured: the nodes are connected directly",
    one.interruptions && `${gap}: what is lost of that time is not counted`,
  ];
  return parts.filter(Boolean).join("; ");
}

const MEANINGS = {
  reliability: "whether messages survive the loss of a link",
  durability: "whether a late subscriber gets the last ones",
  history: "what a full queue keeps",
  depth: "messages that wait for a slow receiver",
  deadline: "longest time between two messages",
  lifespan: "older messages are dropped",
  liveliness: "what shows that a source is alive",
  liveliness_lease: "silence after which a source counts as dead",
  priority: "the lane: high is express, low is bulk",
  max_rate: "messages a second at most",
  outage: "how long it is kept without a link",
  transport: "through the agents, or from node to node",
};
const SECONDS = ["deadline", "lifespan", "liveliness_lease", "outage"];
function term(key, value) {
  if (value === null || value === undefined) return "none";
  if (SECONDS.includes(key)) return seconds(value);
  return key === "max_rate" ? hertz(value) : String(value).replaceAll("_", " ");
}
const TERMS = [
  ["Term", ([key]) => under(key.replaceAll("_", " "), MEANINGS[key])],
  ["Value", ([key, one]) => term(key, one.value)],
  ["~Set by", ([, one]) => one.rule],
];

// What the settings of this module ask for the topic, whether a route is open or not.
function ContractPanel({ connection, topic, type, own, routes }) {
  const { value, failure } = useAnswer(connection, "contract", { topic, type: type === "*" ? "" : type || "" });
  const rows = Object.entries(value || {});
  const set = rows.filter(([, one]) => one.rule !== "default");
  const table = (list) => html`<${Table} caption="Contract" columns=${TERMS} list=${list} />`;
  return html`<${Panel} title=${`Contract, by the settings of ${own}`} wide
    ><${Failure} failure=${failure} /> ${value &&
    (set.length
      ? table(set)
      : html`<p class="empty">No rule of <code>[[contract]]</code> matches it: the defaults apply.</p>`)}
    ${value &&
    !routes &&
    html`<p class="muted">It has no route yet. When a peer subscribes, the stricter terms of both modules apply.</p>`}
    ${value &&
    html`<details>
      <summary>${set.length ? "The terms that no rule sets" : "The defaults"}</summary>
      ${table(rows.filter(([, one]) => one.rule === "default"))}
    </details>`}<//
  >`;
}

const EVENTS = [
  ["Time", (event) => clock(event.at)],
  ["Event", (event) => event.kind.replaceAll("_", " ")],
  ["Source", (event) => event.from],
  ["Text", (event) => event.text],
];
const Events = ({ routes }) => {
  const events = routes.flatMap(([, route]) =>
    (route.recent || []).map((event) => ({ ...event, from: `${route.peer} ${route.node}` })),
  );
  const list = events.sort((a, b) => b.at - a.at);
  return (
    list.length > 0 &&
    html`<${Panel} title="Events of its contract" wide><${Table} caption="Events" columns=${EVENTS} list=${list} /><//>`
  );
};
