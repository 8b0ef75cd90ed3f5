// The first page: all modules on a ring, their links, and what flows.

import { html, memo, useEffect, useRef, useState } from "./markup.js";
import { bandwidth, hertz, seconds } from "./format.js";
import { entries, section } from "./state.js";
import { Outside } from "./outside.js";
import { CENTRE, SIZE, arrange, chord, emptyRing, geometry, outside, place } from "./ring.js";
import { Mark, Page, Panel, Since, known, shape } from "./parts.js";
import { Table } from "./lists.js";
import { Link, href } from "./links.js";

const SPEEDS = [
  [0, "still"],
  [0.5, "slow"],
  [5, "medium"],
  [30, "fast"],
];
const PERIODS = { slow: 2.4, medium: 1.4, fast: 0.8 }; // seconds in which a dot comes to the place of the next one
const DOTS = 20.1; // from one dot to the next
const STEP = 125; // milliseconds between two positions of the dots: without a GPU each costs a drawing

const speedOf = (rate) => SPEEDS.reduce((found, [least, word]) => (rate > least ? word : found), "");
const width = (bytes) => Math.min(9, 2 + Math.max(0, Math.log10((bytes || 0) / 100)) * 1.4);

// What moves is a picture of its own beneath the others, which are not drawn again with it.
const Stream = memo(({ flow, a, b, geo, both }) => {
  const line = chord(a, b, geo.node, both ? 9 : 0);
  const look = `stream ${flow.by === "resource" ? "declared" : ""}`;
  return html`<path class=${look} d=${line.d} stroke-width=${width(flow.bandwidth)} />`;
});

const Flow = memo(({ flow, from, to, a, b, geo, both, labelled, compact }) => {
  const line = chord(a, b, geo.node, both ? 9 : 0);
  const far = Math.hypot(a.x - b.x, a.y - b.y) > geo.ring * 0.9;
  const label = line.at(geo.slots > 8 ? 0.16 : far ? 0.33 : 0.5); // near its source, where chords are apart
  const text = flow.rate === undefined ? "" : hertz(flow.rate);
  labelled = labelled && !(compact && geo.slots > 6 && flow.by === "resource");
  const rates = labelled && !compact && text && geo.slots <= 8 && flow.bandwidth;
  return html`<g class="flow ${flow.by === "resource" ? "declared" : ""}">
    <title>${from} to ${to}: ${text || "rate not known"}, ${flow.topics.join(", ")}</title>
    <path class="pipe" d=${line.d} stroke-width=${width(flow.bandwidth) + 4} marker-end="url(#arrow)" />
    ${labelled && text && html`<text class="rate" x=${label.x} y=${label.y + 6}>${text}</text>`}
    ${rates && html`<text class="minor" x=${label.x} y=${label.y + 30}>${bandwidth(flow.bandwidth)}</text>`}
  </g>`;
});

const Streams = ({ flows, moves }) => {
  const picture = useRef();
  useEffect(() => {
    if (!moves) return undefined;
    const move = () => {
      if (document.hidden) return;
      const now = performance.now() / 1000;
      for (const [speed, period] of Object.entries(PERIODS))
        picture.current.querySelector(`.${speed}`).style.strokeDashoffset = -((now / period) % 1) * DOTS;
    };
    const timer = setInterval(move, STEP);
    return () => clearInterval(timer);
  }, [moves]);
  const of = (speed) =>
    flows.filter(({ flow }) => speedOf(flow.rate || 0) === speed).map((one) => html`<${Stream} ...${one} />`);
  return html`<svg ref=${picture} class="streams" viewBox="0 0 ${SIZE} ${SIZE}" aria-hidden="true">
    ${SPEEDS.map(([, speed]) => html`<g key=${speed} class=${speed}>${of(speed)}</g>`)}
  </svg>`;
};

const Wire = memo(({ module, a, b, geo, labelled }) => {
  const line = chord(a, b, geo.node, 0);
  const middle = line.at(0.5);
  const about = known(module.state);
  const quiet = module.state === "up" || module.state === "relayed";
  return html`<g class="wire ${module.state} ${about.tone}"
    ><path d=${line.d} />${!quiet &&
    html`<g class="seal" transform="translate(${middle.x} ${middle.y})"
      ><circle r="19" /><svg x="-11" y="-11" width="22" height="22" viewBox="0 0 16 16">${shape(module.state)}</svg></g
    >`}
    ${!quiet && labelled && html`<text class="word" x=${middle.x} y=${middle.y + 42}>${about.word}</text>`}</g
  >`;
});

function arc(x, y, radius, from, to) {
  const p = (at) => `${(x + radius * Math.cos(at)).toFixed(1)} ${(y + radius * Math.sin(at)).toFixed(1)}`;
  return `M${p(from)}A${radius} ${radius} 0 ${to - from > Math.PI ? 1 : 0} 1 ${p(to)}`;
}

// One arc around its module for each Smart Resource; its colour is the quality's level, its pattern too.
const Arcs = ({ at, geo, resources }) => {
  const part = (2 * Math.PI) / resources.length;
  const gap = 0.09;
  return resources.map(
    ([key, one], index) =>
      html`<path
        key=${key}
        class="quality ${known(one.level).tone} level-${(one.level || "none").toLowerCase()}"
        d=${arc(at.x, at.y, geo.node + 8, -Math.PI / 2 + index * part + gap, -Math.PI / 2 + (index + 1) * part - gap)}
      />`,
  );
};

const LEVELS = ["ERROR", "STALE", "WARN", "OK"]; // the worst first
const worst = (resources) => LEVELS.find((level) => resources.some(([, one]) => one.level === level)) || "";

const Module = memo(({ name, module, at, geo, resources, alarms, compact }) => {
  const about = known(module.state);
  const profile =
    resources.length === 1 ? resources[0][1].profile : resources.length ? `${resources.length} resources` : "";
  const { small } = geo;
  const level = worst(resources);
  const label = small ? outside(at, geo) : { x: at.x, y: at.y - (compact ? 22 : 16), anchor: "middle" };
  const mark = small ? (geo.node > 30 ? 24 : 18) : compact ? 32 : 20;
  const markBox = {
    x: at.x - mark / 2,
    y: at.y - mark / 2 + (small ? 0 : compact ? 18 : 13),
    width: mark,
    height: mark,
  };
  const limit = compact ? 9 : small ? 12 : geo.slots > 8 ? 9 : 11;
  const short = name.length > limit ? `${name.slice(0, limit - 1)}…` : name;
  const running = profile && !["away", "linking", "lost"].includes(module.state) && profile.slice(0, limit);
  const word = small ? "" : running || (compact && module.state === "here" ? "here" : about.word);
  // The name begins with the text that is seen, so that a user can say what they see.
  const quality = level && `quality ${known(level).word}`;
  const bell = alarms && `${alarms} alarm${alarms > 1 ? "s" : ""}`;
  const parts = [
    short,
    word,
    bell,
    short !== name && name,
    `link ${about.word}`,
    profile && `profile ${profile}`,
    quality,
  ];
  const said = parts.filter(Boolean).join(", ");
  return html`<a
    class="module ${module.state} ${about.tone}"
    href=${href("module", name)}
    aria-label=${said}
    data-module=${name}
  >
    <circle class="halo" cx=${at.x} cy=${at.y} r=${geo.node + 16} />
    <circle class="body" cx=${at.x} cy=${at.y} r=${geo.node} />
    ${resources.length > 0 && html`<${Arcs} at=${at} geo=${geo} resources=${resources} />`}
    <text class="name" x=${label.x} y=${label.y} text-anchor=${label.anchor}>${short}</text>
    <g class="state"><svg ...${markBox} viewBox="0 0 16 16">${shape(module.state)}</svg></g>
    ${" "}${!small && html`<text class="word" x=${at.x} y=${at.y + (compact ? 66 : 46)}>${word}</text>`}
    ${" "}${alarms > 0 &&
    html`<g class="bell" transform="translate(${at.x + geo.node * 0.72} ${at.y - geo.node * 0.72})"
      ><circle r="20" /><text y="8">${alarms}</text></g
    >`}
  </a>`;
});

// The arrow keys go around the ring, in the order of the places.
function step(event, order) {
  const by = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
  const here = event.target.closest && event.target.closest("[data-module]");
  if (!by || !here) return;
  event.preventDefault();
  const at = order.indexOf(here.dataset.module);
  const next = order[(at + by + order.length) % order.length];
  [...event.currentTarget.querySelectorAll("[data-module]")].find((each) => each.dataset.module === next)?.focus();
}

// A browser tells no change that was read before it is told: `matches` is read here at the first drawing alone.
function useQuery(text) {
  const [query] = useState(() => matchMedia(text));
  const [matches, set] = useState(() => query.matches);
  useEffect(() => {
    const change = () => set(query.matches);
    query.addEventListener("change", change);
    change(); // it may have changed between the drawing and this effect
    return () => query.removeEventListener("change", change);
  }, []);
  return matches;
}

// The same object for the same arguments, so that what did not move is not drawn again.
function cached(make) {
  const made = new Map();
  return (...given) => {
    const key = JSON.stringify(given);
    if (!made.has(key)) made.set(key, make(...given));
    return made.get(key);
  };
}
const point = cached(place);
const sizes = cached(geometry);

const around = emptyRing();
const arranged = (state) => arrange(around, section(state, "agent").name, Object.keys(section(state, "modules")));

const SQUARE = { viewBox: "0 0 8 8", refX: 6.5, refY: 4, markerWidth: 14, markerHeight: 14 };
const MARKER = { ...SQUARE, markerUnits: "userSpaceOnUse", orient: "auto" };

export function Ring({ state, current }) {
  const compact = useQuery("(max-width: 640px)");
  const still = useQuery("(prefers-reduced-motion: reduce)");
  const { slots, places } = arranged(state);
  const geo = sizes(slots, compact);
  const modules = section(state, "modules");
  const names = Object.keys(modules)
    .filter((name) => name in places)
    .sort((a, b) => places[a] - places[b]);
  const at = (name) => point(places[name], geo);
  const own = section(state, "agent").name;
  const both = (from, to) => `${to}>${from}` in section(state, "flows");
  const flows = entries(state, "flows")
    .map(([key, flow]) => [key, ...key.split(">"), flow])
    .filter(([, from, to]) => from in places && to in places)
    .map(([key, from, to, flow]) => ({ key, from, to, flow, geo, a: at(from), b: at(to), both: both(from, to) }));
  const resources = entries(state, "resources");
  const alarms = entries(state, "alarms");
  const labelled = names.length <= 16;
  const taken = new Set(names.map((name) => places[name]));
  const vacant = Array.from({ length: geo.slots }, (_, slot) => slot).filter((slot) => !taken.has(slot));
  return html`<div class="ring">
    <${Streams} flows=${flows} moves=${current && !still && flows.length > 0} />
    <svg
      class="mandala ${compact ? "compact" : ""} ${geo.slots > 8 ? "many" : ""}"
      viewBox="0 0 ${SIZE} ${SIZE}"
      role="group"
      aria-label="Modules, their links, and what flows between them"
      onKeyDown=${(event) => step(event, names)}
    >
      <defs>
        <marker id="arrow" ...${MARKER}>
          <path class="head" d="M.8.8 7 4 .8 7.2 2.6 4Z" />
        </marker>
      </defs>
      <circle class="dial" cx=${CENTRE} cy=${CENTRE} r=${geo.ring} />
      ${vacant
        .map((slot) => point(slot, geo))
        .map(({ x, y }, key) => html`<circle key=${key} class="vacant" cx=${x} cy=${y} r="5" />`)}
      <g>
        ${names
          .filter((name) => name !== own)
          .map((name) => ({ key: name, module: modules[name], a: at(own), b: at(name), geo }))
          .map((wire) => html`<${Wire} ...${wire} labelled=${labelled && !compact} />`)}
      </g>
      <g>${flows.map((one) => html`<${Flow} ...${{ ...one, labelled, compact }} />`)}</g>
      <g>
        ${names.map(
          (name) =>
            html`<${Module}
              key=${name}
              ...${{ name, geo, compact, module: modules[name], at: at(name) }}
              resources=${resources.filter(([, one]) => one.module === name)}
              alarms=${alarms.filter(([, one]) => one.module === name).length}
            />`,
        )}
      </g>
    </svg>
  </div>`;
}

// What was lost with a link, until it is back: the topics that stopped, and messages.
export function costs(lost) {
  if (!lost) return "";
  const topics = Object.entries(lost.topics || {}).map(([name, rate]) => (rate ? `${name} (${hertz(rate)})` : name));
  const stopped = topics.length ? `. Stopped: ${topics.slice(0, 5).join(", ")}` : ". No topic was in use";
  const left = Math.max(0, topics.length - 5) + (lost.more || 0);
  const rest = left ? ` and ${left} more` : "";
  const kept = lost.kept ? `; ${count(lost.kept, "message")} wait for it` : "";
  return `${stopped}${rest}${kept}${lost.dropped ? `; ${count(lost.dropped, "message")} dropped` : ""}`;
}

const some = (names) => `${names.slice(0, 3).join(", ")}${names.length > 3 ? " …" : ""}`;

// What nodes say on /diagnostics: each error, and a line for all warnings.
function diagnosed({ errors, more, warnings = [], stale = [], problems = [] }, own, modules) {
  const to = href("diagnostics");
  // What a module said whose link is lost is old, which the line of the module says already.
  const here = (module) => !module || !["lost", "away"].includes(modules[module]?.state);
  const those = (list) => list.filter(([module]) => here(module)).map(([, name]) => name);
  [warnings, stale] = [those(warnings), those(stale)];
  const current = Object.entries(errors || {}).filter(([, one]) => here(one.module));
  const found = current.map(([key, one]) => ({
    id: `d${key}`,
    level: one.level,
    who: [one.module || own, one.hardware !== one.module && one.hardware].filter(Boolean).join(" "),
    text: `${one.name}: ${one.message}${one.level === "STALE" ? " (nothing since)" : ""}`,
    to: href("diagnostics", key),
    since: one.since,
  }));
  const line = (level, who, text) => found.push({ id: `d${who}`, level, who, text, to });
  if (more) line("ERROR", `${more} more`, "errors on /diagnostics");
  if (warnings.length) line("WARN", count(warnings.length, "warning"), `of nodes: ${some(warnings)}`);
  if (stale.length) line("STALE", count(stale.length, "stale status", "stale statuses"), `of nodes: ${some(stale)}`);
  for (const text of problems) line("WARN", "/diagnostics", text);
  return found;
}
const count = (number, one, several = `${one}s`) => `${number} ${number > 1 ? several : one}`;

function concerns(state) {
  const found = [];
  const say = (id, level, who, text, to, since) => found.push({ id, level, who, text, to, since });
  for (const [id, { level, text, resource, module, at }] of entries(state, "alarms"))
    say(id, level, resource || module, text, resource ? href("resource", resource) : href("alarms"), at);
  for (const [name, { state: link, error, lost, since }] of entries(state, "modules")) {
    const to = href("module", name);
    if (["up", "here", "relayed"].includes(link)) {
      if (error) say(`m${name}`, "WARN", name, error, to);
      continue;
    }
    const level = { refused: "ERROR", lost: "ERROR", away: "STALE" }[link] || "WARN";
    say(`m${name}`, level, name, `${known(link).word}${error ? `: ${error}` : ""}${costs(lost)}`, to, since);
  }
  found.push(...diagnosed(section(state, "diagnostics"), section(state, "agent").name, section(state, "modules")));
  const troubled = new Map(); // many topics have one trouble when a module is lost: that is one line
  for (const [name, topic] of entries(state, "topics"))
    if (topic.problem) troubled.set(topic.problem, [...(troubled.get(topic.problem) || []), name]);
  for (const [text, names] of troubled)
    if (names.length > 1) say(`t${text}`, "WARN", `${names.length} topics`, `${text}: ${some(names)}`, href("topics"));
    else say(`t${text}`, "WARN", names[0], text, href("topic", names[0]));
  const pending = entries(state, "outside").filter(([, one]) => one.state === "pending");
  const invite = "pending: an invitation is needed for a link; see Not in this mesh";
  if (pending.length) say("pending", "WARN", pending.map(([, one]) => one.name).join(", "), invite, href(""));
  for (const note of state.notes || [])
    say(`n${note}`, "WARN", "the agent", note, href("module", section(state, "agent").name));
  return found.sort((a, b) => LEVELS.indexOf(a.level) - LEVELS.indexOf(b.level)); // of one level: causes first
}

export function Concerns({ state, connection }) {
  const found = concerns(state);
  const reach = section(state, "reach");
  const first = (id, who, text, since) =>
    found.unshift({ id, level: "ERROR", who, text, to: location.hash || "#/", since });
  if (connection.phase === "lost")
    first("lost", "rmpa web", "no connection: the page shows what was last known", connection.lostAt / 1000);
  else if (reach.ok === false) first("mute", "the agent", `does not answer: ${reach.error}`, reach.since);
  if (!found.length) return html`<p class="well"><${Mark} state="OK" word="Nothing is wrong." /></p>`;
  return html`<ul class="concerns">
    ${found.slice(0, 50).map(
      (one) =>
        html`<li key=${one.id}>
          <a href=${one.to}
            ><${Mark} state=${one.level} word="" /><span><strong>${one.who}</strong><span>${one.text}</span></span
            >${one.since && html`<span class="muted"><${Since} moment=${one.since} /></span>`}</a
          >
        </li>`,
    )}
  </ul>`;
}

const MODULES = [
  ["Module", ([name]) => html`<${Link} page="module" name=${name} />`],
  ["Link", ([, module]) => html`<${Mark} state=${module.state} />`],
  ["#Round trip", ([, module]) => seconds(module.rtt)],
  ["#In", ([, module]) => bandwidth(module.bytes_in)],
  ["#Out", ([, module]) => bandwidth(module.bytes_out)],
  [
    "Profile",
    ([, , resources]) =>
      resources.map(
        ([key, one]) =>
          html`<div key=${key}>
            <a href=${href("resource", key)}><${Mark} state=${one.level} word=${one.profile || "no profile"} /></a>
          </div>`,
      ),
  ],
];
const FLOWS = [
  ["From → to", ([key]) => key.replace(">", " → ")],
  ["#Messages", ([, flow]) => hertz(flow.rate)],
  ["#Bytes", ([, flow]) => bandwidth(flow.bandwidth)],
  [
    "Topics",
    ([, flow]) => flow.topics.map((topic, at) => html`${at > 0 && ", "}<a href=${href("topic", topic)}>${topic}</a>`),
  ],
];

export function Mandala({ state, connection }) {
  const current = connection.phase !== "lost" && section(state, "reach").ok !== false;
  const modules = entries(state, "modules"),
    resources = entries(state, "resources");
  const up = modules.filter(([, one]) => one.state === "up" || one.state === "here").length;
  const domain = section(state, "agent").domain ?? "–";
  const total = modules.length + (section(state, "hidden").modules || 0);
  const marks = ["up", "relayed", "silent", "linking", "refused", "away", "lost"].filter(
    (each) => !["relayed", "lost"].includes(each) || modules.some(([, one]) => one.state === each),
  );
  const { places } = arranged(state);
  const ordered = modules
    .sort(([a], [b]) => (places[a] ?? 1e9) - (places[b] ?? 1e9))
    .map(([name, module]) => [name, module, resources.filter(([, one]) => one.module === name)]);
  return html`<${Page}
    title="Mesh"
    kind=${`Domain ${domain} · ${up} of ${total} modules up${current ? "" : " when last heard of"}`}
  >
    <div class="overview">
      <div class="stage-area">
        <${Ring} state=${state} current=${current} />
        <p class="legend" aria-hidden="true">
          ${marks.map((each) => html`<${Mark} key=${each} state=${each} />`)}<span class="mark flowkey"
            ><svg viewBox="0 0 26 16"><path d="M1 8h22" /></svg>messages</span
          >
        </p>
      </div>
      <div class="beside">
        <${Panel} title="What is wrong"><${Concerns} state=${state} connection=${connection} /><//>
        <${Outside} state=${state} connection=${connection} />
        <${Panel} title="Modules"
          ><${Table} caption="Modules" columns=${MODULES} list=${ordered} /> ${total > modules.length &&
          html`<p class="empty">The server leaves out ${total - modules.length} further modules.</p>`}<//
        >
        <${Panel} title="Flows"
          ><${Table}
            caption="Flows between modules"
            columns=${FLOWS}
            empty="No messages cross at present."
            list=${entries(state, "flows")}
        /><//>
      </div></div
  ><//>`;
}
