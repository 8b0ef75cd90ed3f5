// All topics, and one of them: which node sends it to which, how fast, how late, what is lost, and what is in it.

import { html, useState } from "../markup.js";
import { bandwidth, clock, count, hertz, seconds } from "../format.js";
import { entries, section } from "../state.js";
import {
  Choice,
  Facts,
  Failure,
  Gone,
  Link,
  Mark,
  NodeLink,
  NodeLinks,
  Page,
  Panel,
  Since,
  Table,
  Why,
  memo,
  nodeKey,
  useAnswer,
  useFilter,
  useKept,
} from "../parts.js";
import { Lines } from "../plot.js";
import { Live } from "../live.js";
import { PublishPanel } from "../publish.js";

export const TOPIC_COLUMNS = ["Topic", "#Rate", "#Bytes", "Type", "#Latency", "#Lost", "From → to"];
const lostOf = (topic) => (topic.lost || 0) + (topic.dropped || 0);
const KEYS = {
  Topic: ([name]) => name,
  Type: ([, topic]) => topic.type,
  "#Rate": ([, topic, measured]) => measured?.rate ?? topic.rate,
  "#Bytes": ([, topic, measured]) => measured?.bandwidth ?? topic.bandwidth,
  "#Latency": ([, topic]) => topic.latency,
  "#Lost": ([, topic]) => lostOf(topic) || undefined,
  "From → to": ([, topic]) => (topic.from || []).join(", "),
};

// How a rate was measured where the topic is published; what is not measured says why.
const WAYS = {
  counted: "counted by its publisher",
  sampled: "measured by a short subscription where it is published",
  "no subscriber": "its publisher may work for subscribers only, and is not woken: Live on its page measures it",
};
function Rate({ topic, measured }) {
  if (topic.stopped)
    return html`<span class="muted">${hertz(topic.rate)}</span>
      <div class="muted">stopped <${Since} moment=${topic.stopped} text=${(shown) => `${shown} ago`} /></div>`;
  if (!measured) return hertz(topic.rate);
  if (measured.rate === undefined)
    return html`–${" "}<span class="muted" title=${WAYS[measured.how]}>${measured.how}</span>`;
  return html`<span title=${WAYS[measured.how]}>${measured.rate ? hertz(measured.rate) : "none in 2 s"}</span>`;
}

export const TopicRow = memo(
  ({ name, topic, measured }) =>
    html`<tr class=${topic.stopped ? "old" : ""}>
      <th scope="row">
        <${Link} page="topic" name=${name} />${topic.problem &&
        html`<div class="muted"><${Mark} state="WARN" word=${""} />${topic.problem}</div>`}
      </th>
      <td class="number"><${Rate} topic=${topic} measured=${measured} /></td>
      <td class="number">${bandwidth(measured?.bandwidth || topic.bandwidth)}</td>
      <td><span class="muted">${topic.type}</span></td>
      <td class="number">${seconds(topic.latency)}</td>
      <td class="number">${lostOf(topic) ? count(lostOf(topic)) : "–"}</td>
      <td class="ends">
        ${(topic.from || []).join(", ") || html`<span class="muted">no publisher</span>`}
        ${" "}→${" "}${(topic.to || []).join(", ") ||
        html`<span class="muted">no subscriber here</span>`}${topic.crosses
          ? ""
          : html` <span class="muted">does not cross</span>`}
      </td>
    </tr>`,
);

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
      ><${Table} caption="Topics" columns=${TOPIC_COLUMNS} keys=${KEYS} empty="No topic matches." list=${shown}>
        ${([name, one, rate]) => html`<${TopicRow} key=${name} name=${name} topic=${one} measured=${rate} />`}<//
      >
      ${which === "data" &&
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
      ><${PublishPanel} connection=${connection} state=${state} topic=${name}
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
              (detail.publishers || []).length > 0 ? html`<${NodeLinks} names=${detail.publishers} />` : "",
            ],
            [
              `Subscribers in ${own}`,
              (detail.subscribers || []).length > 0 ? html`<${NodeLinks} names=${detail.subscribers} />` : "",
            ],
            [
              "Elsewhere",
              detail.remote_subscribers?.length ? html`<${NodeLinks} names=${detail.remote_subscribers} />` : "",
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
          columns=${[
            "Source",
            "State",
            "#Rate",
            "#Jitter p99",
            "#Latency p50, p99",
            "#Lost",
            "#Dropped",
            "Transport",
            "Contract",
          ]}
          empty="It has no route to or from a peer."
          list=${routes}
        >
          ${([key, route]) => html`<${Route} key=${key} route=${route} own=${own} />`}<//
        ><//
      >
      <${ContractPanel} connection=${connection} topic=${name} type=${topic.type} own=${own} routes=${routes.length} />
      <${Events} routes=${routes} /></div
  ><//>`;
}

const Route = memo(({ route, own }) => {
  const latency = section(route, "latency");
  const contract = Object.entries(route.contract || {})
    .map(([key, value]) => `${key} ${value}`)
    .join(", ");
  return html`<tr>
      <th scope="row">
        <${NodeLink} name=${nodeKey(route.direction === "in" ? route.peer : "", route.node)} />
        <div class="muted">${route.direction === "in" ? `${route.peer} → ${own}` : `${own} → ${route.peer}`}</div>
      </th>
      <td>
        ${route.state}${route.stopped &&
        html`<div>
          <${Mark} state="STALE" word="stopped" />${" "}<${Since}
            moment=${route.stopped}
            text=${(shown) => `${shown} ago`}
          />
        </div>`}${route.problem && html`<div class="muted">${route.problem}</div>`}
      </td>
      <td class=${route.stopped ? "number muted" : "number"}>
        ${hertz(route.rate)}
        <div class="muted">${bandwidth(route.bandwidth)}</div>
      </td>
      <td class="number">${seconds(route.jitter)}</td>
      <td class="number">
        ${seconds(latency.p50)}, ${seconds(latency.p99)}
        <div class="muted">± ${seconds(latency.error)}</div>
      </td>
      <td class="number">
        ${(route.events || {}).loss_unknown ? "unknown, ≥ " : ""}${count((route.lost || 0) + (route.expired || 0))}
      </td>
      <td class="number">${count((route.dropped || 0) + (route.oversized || 0))}</td>
      <td>
        ${route.transport || "–"}${route.lane &&
        html`<div class="muted">${route.lane} lane</div>`}${route.condition_text &&
        html`<div class="muted">${route.condition_text}</div>`}
      </td>
      <td>
        ${contract || "default"}${Object.entries(route.events || {}).map(
          ([kind, times]) => html`<div class="muted" key=${kind}>${kind.replaceAll("_", " ")}: ${count(times)}</div>`,
        )}
      </td>
    </tr>
    ${(route.subscribers || []).map((one) => html`<${Subscriber} key=${one.node} one=${one} />`)}`;
});

// A subscriber of a route where its transport is known: the agents see no message of direct ones.
const Subscriber = ({ one }) => {
  const said = [
    one.condition && one.text,
    one.transport === "direct" && "not measured: the nodes are connected directly",
    one.interruptions &&
      `interrupted ${count(one.interruptions)} times, the last for ${seconds(one.interrupted)}: ` +
        "what is lost of that time is not counted",
  ]
    .filter(Boolean)
    .join("; ");
  return html`<tr>
    <th scope="row" class="inner"><span class="mono">→ ${one.node}</span></th>
    <td>${one.state}${said && html`<div class="muted">${said}</div>`}</td>
    <td class="number">–</td>
    <td class="number">–</td>
    <td class="number">–</td>
    <td class="number">–</td>
    <td class="number">–</td>
    <td>${one.transport || "–"}${one.endpoint && html`<div class="muted">${one.endpoint}</div>`}</td>
    <td>${one.wanted || ""}</td>
  </tr>`;
};

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
const term = (key, value) =>
  value === null || value === undefined
    ? "none"
    : SECONDS.includes(key)
      ? seconds(value)
      : key === "max_rate"
        ? hertz(value)
        : String(value).replaceAll("_", " ");

// What the settings of this module ask for the topic, whether a route is open or not.
function ContractPanel({ connection, topic, type, own, routes }) {
  const { value, failure } = useAnswer(connection, "contract", { topic, type: type === "*" ? "" : type || "" });
  const rows = Object.entries(value || {});
  const set = rows.filter(([, one]) => one.rule !== "default");
  const table = (shown) =>
    html`<${Table} caption="Contract" columns=${["Term", "Value", "Set by"]}
      >${shown.map(
        ([key, one]) =>
          html`<tr key=${key}>
            <th scope="row">
              ${key.replaceAll("_", " ")}
              <div class="muted">${MEANINGS[key] || ""}</div>
            </th>
            <td>${term(key, one.value)}</td>
            <td class="muted">${one.rule}</td>
          </tr>`,
      )}<//
    >`;
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

const Events = ({ routes }) => {
  const events = routes.flatMap(([, route]) =>
    (route.recent || []).map((event) => ({ ...event, from: `${route.peer} ${route.node}` })),
  );
  return (
    events.length > 0 &&
    html`<${Panel} title="Events of its contract" wide
      ><${Table} caption="Events" columns=${["Time", "Event", "Source", "Text"]}
        >${events
          .sort((a, b) => b.at - a.at)
          .map(
            (event) =>
              html`<tr key=${event.from + event.kind + event.at}>
                <th scope="row">${clock(event.at)}</th>
                <td>${event.kind.replaceAll("_", " ")}</td>
                <td>${event.from}</td>
                <td>${event.text}</td>
              </tr>`,
          )}<//
      ><//
    >`
  );
};
