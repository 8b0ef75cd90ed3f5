// Smart Resources, and one of them: what it did and why, its profiles, clients, contexts, configuration and processes.

import { html, useState } from "../markup.js";
import { seconds } from "../format.js";
import { entries, section } from "../state.js";
import { Facts, Failure, Gone, Mark, Page, Panel, Since, under } from "../parts.js";
import { Table } from "../lists.js";
import { Link, ModuleLink, href } from "../links.js";
import { Editable } from "../asking.js";
import { setting } from "../typed.js";
import { Decisions, Timeline, usePast } from "../timeline.js";
import { Launches } from "../launches.js";

const RESOURCES = [
  ["Resource", ([name, one]) => under(html`<${Link} page="resource" name=${name}>${one.name}<//>`, one.description)],
  ["Module", ([, one]) => html`<${ModuleLink} name=${one.module} />`],
  ["Role", ([, one]) => html`${one.role}${!one.physical && html` <span class="muted">simulated</span>`}`],
  ["Quality", ([, one]) => under(html`<${Mark} state=${one.level} />`, one.message)],
  ["Profile", ([, one]) => one.profile || "none"],
  ["Context", ([, one]) => one.context || "–"],
  ["#Clients", ([, one]) => one.clients || 0],
];

export function Resources({ state, connection }) {
  const all = entries(state, "resources");
  return html`<${Page} title="Smart Resources" kind=${`${all.length} in all modules`}
    ><${Panel}
      ><${Table}
        caption="Smart Resources"
        columns=${RESOURCES}
        empty="No module has a Smart Resource."
        list=${all} /><//
    ><${Launches} ...${{ state, connection }}
  /><//>`;
}

const said = (values) =>
  Object.entries(values || {})
    .map(([key, value]) => `${key} ${value}`)
    .join(", ") || "–";
const QUALITY = [
  ["Attribute", (each) => each.name],
  ["#Now", (each, { values }) => quantity(values[each.name])],
  ["Better", ({ better }) => ({ max: "more", min: "less" })[better] ?? better],
  ["Class", (each) => each.category],
];
const CLIENTS = [
  ["Client", (client) => client.name],
  ["Is told", (client) => html`<${Mark} state=${client.level} word=${client.message} />`],
  [
    "Asks",
    (client) => Object.entries(client.values || {}).map(([key, value]) => html`<div key=${key}>${key} ${value}</div>`),
  ],
];
const CONTEXTS = [
  [
    "Context",
    (each, { resource }) =>
      each.name === resource.context ? html`<${Mark} state="up" word=${each.name} />` : each.name,
  ],
  ["When", (each) => each.when || "by hand"],
  ["Requires", (each) => said(each.requires)],
  ["Profiles", (each) => (each.profiles || []).join(", ") || "all"],
  [
    "#",
    (each, { resource, choose }) => {
      const here = each.name === resource.context;
      return (
        choose &&
        html`<button type="button" onClick=${() => choose("context", here ? "" : each.name)}>
          ${here ? "Leave" : "Enter"}
        </button>`
      );
    },
  ],
];
const range = ({ choices, low, high, type }) =>
  choices?.length
    ? choices.join(" | ")
    : low !== undefined || high !== undefined
      ? `${low ?? ""} … ${high ?? ""}`
      : type;
const PARAMETERS = [
  [
    "Parameter",
    (each, { hands }) =>
      under(each.name, each.name in hands && html`<${Mark} state="WARN" word="turned by hand" />`, each.binding),
  ],
  [
    "#Value",
    (each, { now, set }) =>
      html`<${Setting}
        value=${now[each.name] ?? each.default}
        about=${each}
        set=${set && ((value) => set(each.name, value))}
      />`,
  ],
  ["Range", range],
  ["Description", (each) => each.description],
];
const TOPICS = [
  ["Topic", (each) => html`<${Link} page="topic" name=${each.topic} />`],
  ["Way", (each) => each.way],
  ["Type", (each) => each.type],
  ["Contract", (each) => said(each.contract)],
];
const PROFILES = [
  [
    "Profile",
    (each, { resource }) =>
      under(
        each.name === resource.profile ? html`<${Mark} state="up" word=${`${each.name} runs`} />` : each.name,
        Object.keys(each.sets || {}).length > 0 && `sets ${said(each.sets)}`,
        each.nodes?.length > 0 && `needs ${each.nodes.join(", ")}`,
      ),
  ],
  ["Declared", (each, { units }) => amounts(each.offers, units)],
  ["Learnt", (each, { learnt, units }) => amounts(learnt[each.name], units)],
  ["#Cost", (each) => each.cost],
  ["Description", (each) => each.description],
  [
    "#",
    (each, { decision, choose }) => {
      const chosen = decision.chosen === each.name;
      return (
        choose &&
        html`<button type="button" onClick=${() => choose("profile", chosen ? "" : each.name)}>
          ${chosen ? "Let it decide" : "Choose"}
        </button>`
      );
    },
  ],
];

export function ResourcePage({ name, state, connection }) {
  const one = section(state, "resources")[name];
  const [failure, setFailure] = useState(null);
  if (!one) return html`<${Page} title=${name} kind="Smart Resource"><${Gone} kind="resource" name=${name} /><//>`;
  const detail = section(section(state, "detail"), `resource:${name}`);
  const descriptor = section(detail, "descriptor"),
    decision = section(detail, "decision"),
    values = section(section(detail, "health"), "values");
  const whose = { resource: one.name, peer: one.module === section(state, "agent").name ? "" : one.module };
  const may = connection.may("control");
  const choose =
    may && ((what, choice) => connection.ask(what, { ...whose, choice }).then(() => setFailure(null), setFailure));
  const set = may && ((parameter, value) => connection.told("configure", { ...whose, name: parameter, value }));
  const { attributes = [], profiles = [], nodes = [] } = descriptor;
  const hands = section(decision, "by_hand");
  const alarms = entries(state, "alarms").filter(([, each]) => each.resource === name);
  const units = Object.fromEntries(attributes.map((each) => [each.name, each.unit]));
  const lists = [
    ["Quality", QUALITY, attributes.filter((each) => each.name in values), "It has measured nothing yet.", "Quality"],
    ["Who asked what", CLIENTS, detail.clients, "No client asks for anything.", "Clients"],
    ["Contexts", CONTEXTS, detail.contexts || descriptor.contexts, "It has no contexts.", "Contexts"],
    ["Configuration", PARAMETERS, descriptor.parameters, "It has no parameters.", "Parameters"],
    [
      "Topics",
      TOPICS,
      ["out", "in"].flatMap((way) =>
        (descriptor[`${way}puts`] || []).map((each) => ({ ...each, way, name: way + each.topic })),
      ),
      "",
      "Topics",
    ],
  ];
  const about = {
    ...{ resource: one, values, decision, units, choose, set, hands },
    now: section(detail, "parameters"),
    learnt: section(decision, "learnt"),
  };
  return html`<${Page}
    title=${one.name}
    kind=${`Smart Resource of ${one.module} · ${one.role || ""}${one.physical ? "" : ", simulated"}`}
    aside=${html`<${Mark} state=${one.level} word=${one.message || undefined} />${may &&
      descriptor.file &&
      !whose.peer &&
      html`<a class="button" href=${href("file", descriptor.file)}>Edit</a>`}`}
    ><div class="grid">
      <${Past} ...${{ connection, name, one, detail, decision, profiles, units }} peer=${whose.peer} />
      <${Panel} title="State" wide
        ><p>${one.description}</p>
        <${Facts}
          rows=${[
            ["State", one.state],
            ["Profile", one.profile || "none runs"],
            ["Context", one.context || "none"],
            ["Chosen", decision.chosen ? `${decision.chosen}, by hand` : "by the resource"],
            ["Being applied", decision.applying],
            ["Last reaction", seconds(decision.reaction)],
            ["Turned by hand", said(hands)],
            ["Alarm", decision.alarm],
          ]}
        /><${Failure} failure=${failure} /> ${(decision.conflicts || []).length > 0 &&
        html`<p class="failure">
          ${decision.conflicts.map((each) => (typeof each === "string" ? each : JSON.stringify(each))).join("; ")}
        </p>`}<//
      >
      <${Panel} title="Profiles" wide
        ><${Table} caption="Profiles" columns=${PROFILES} ...${{ about }} list=${profiles} empty="It has no profiles."
      /><//>
      ${alarms.length > 0 &&
      html`<${Panel} title="Alarms" wide
        >${alarms.map(
          ([id, each]) =>
            html`<p key=${id}><${Mark} state=${each.level} word=${each.text} /> for <${Since} moment=${each.at} /></p>`,
        )}<//
      >`}
      ${(nodes.length > 0 || descriptor.file) &&
      html`<${Launches} ...${{ state, connection, nodes }} only=${{ module: one.module, file: descriptor.file }} />`}
      ${lists.map(
        ([title, columns, list = [], empty, caption]) =>
          html`<${Panel} key=${title} title=${title}><${Table} ...${{ caption, columns, list, about, empty }} /><//>`,
      )}
    </div><//
  >`;
}

function Past({ connection, name, peer, one, detail, decision, profiles, units }) {
  const base = section(detail, "descriptor").name;
  const told = { decision, health: detail.health, profile: one.profile };
  const past = usePast(connection, name, told, base && [peer, base, base]);
  const explain = (scores, profile, when) =>
    html`<${Distances} ...${{ scores, profile }} /><${Terms} scores=${scores} caption=${`Terms ${when}`} />`;
  return html`<${Panel} title="The last ten minutes" wide
      ><${Timeline} ...${{ past, decision, units }} profiles=${profiles.map((each) => each.name)}
    /><//>
    <${Panel} title="The last ten decisions" wide><${Decisions} ...${{ past, decision, explain }} /><//>`;
}

// A parameter's value; with the right to, it can be changed. What the resource made of it is said.
function Setting({ value, about, set }) {
  const written = typeof value === "string" ? value : JSON.stringify(value);
  const shown = `${written || "–"} ${about.unit || ""}`.trim();
  if (!set) return shown;
  const save = (draft) => {
    const typed = setting(draft, about);
    if (typed.error) return Promise.resolve({ failure: typed });
    return set(typed.value).then(({ value: done, failure }) => (failure ? { failure } : { said: done.text }));
  };
  const choices = about.choices?.length ? about.choices.map(String) : about.type === "bool" ? ["true", "false"] : null;
  return html`<${Editable} label=${about.name} ...${{ shown, save, choices }} begin=${written ?? ""} />`;
}

// "0.000797688 m/s²" with four digits.
function quantity(text) {
  const [number, ...unit] = text.split(" ");
  return Number.isFinite(Number(number)) && number !== ""
    ? [Number(Number(number).toPrecision(4)), ...unit].join("\u2009")
    : text;
}

const learntOf = ({ median, spread, n }, unit = "") => `${cell(median)} ± ${cell(spread)}${unit} (${n})`;
// Offers as their author declared them, or as they were learnt from so many windows.
const amounts = (offers, units) => {
  const lines = Object.entries(offers || {}).map(([key, value]) => {
    const unit = units[key] ? `\u2009${units[key]}` : "";
    return [key, typeof value === "object" ? learntOf(value, unit) : `${value}${unit}`];
  });
  return lines.length ? lines.map(([key, text]) => html`<div key=${key}>${key} ${text}</div>`) : "–";
};

// A bar for each profile: how far it is from what is asked. The nearest feasible one runs.
function Distances({ scores, profile }) {
  const finite = scores.map((each) => each.distance).filter(Number.isFinite);
  const most = Math.max(...finite, 0.01);
  const tall = 34;
  return html`<svg
      class="bars"
      viewBox=${`0 0 400 ${scores.length * tall + 4}`}
      role="img"
      aria-label=${scores
        .map((each) => {
          const excluded = each.excluded ? `, excluded: ${each.excluded}` : "";
          return `${each.profile}: distance ${each.distance ?? "unbounded"}${excluded}`;
        })
        .join("; ")}
    >
      ${scores.map((each, at) => {
        const y = at * tall + 4;
        const length = Math.max(2, (Math.min(each.distance ?? most, most) / most) * 200);
        return html`<g key=${each.profile}>
          <text x="0" y=${y + 17}>${each.profile === profile ? "● " : ""}${each.profile}</text
          ><rect class="track" x="130" y=${y + 4} width="200" height="16" rx="3" />
          <rect
            class=${each.excluded || !each.feasible ? "hard" : each.profile === profile ? "soft" : "none"}
            x="130"
            y=${y + 4}
            width=${length}
            height="16"
            rx="3"
          />
          <text x="338" y=${y + 17}
            >${each.excluded ? "excluded" : !each.feasible ? "infeasible" : cell(each.distance)}</text
          ></g
        >`;
      })}
    </svg>
    <p class="muted">Shorter is nearer to what is asked for. Red: it cannot be chosen.</p>`;
}

const cell = (value) =>
  value === undefined || value === null
    ? "–"
    : typeof value === "number"
      ? Number(value.toPrecision(4))
      : typeof value === "object"
        ? learntOf(value)
        : String(value);

function Terms({ scores, caption }) {
  const terms = scores.flatMap((score) => (score.terms || []).map((term) => [score, term]));
  const keys = [...new Set(terms.flatMap(([, term]) => Object.keys(term)))];
  const rest = scores.filter((each) => !(each.terms || []).length);
  const columns = [["Profile", ([score]) => score.profile], ...keys.map((key) => [key, ([, term]) => cell(term[key])])];
  return html`${terms.length > 0 && html`<${Table} ...${{ caption, columns }} list=${terms} />`}
  ${rest.map(
    (each) =>
      html`<p key=${each.profile} class="empty">
        ${each.profile}:${" "}${each.excluded ||
        `nothing is asked of it; its distance ${cell(each.distance)} is its cost alone`}
      </p>`,
  )}`;
}
