// What nodes of all modules say on /diagnostics: a tree by module, hardware and name, and one status with its past.

import { html, memo, useEffect, useRef, useState } from "../markup.js";
import { count, plain } from "../format.js";
import { adopt, entries, section } from "../state.js";
import { Choice, Facts, Mark, Page, Panel, Since, known } from "../parts.js";
import { Table, useFilter, useFirst } from "../lists.js";
import { ModuleLink, NodeLink, href, nodeKey } from "../links.js";
import { Plot, figure, toggled } from "../plot.js";

const LEVELS = ["OK", "WARN", "STALE", "ERROR"]; // the best first, as in observe/diagnostics.py
const rank = (level) => LEVELS.indexOf(level);
const SPAN = 600; // seconds of a strip
const REDRAWN = 5000; // milliseconds after which a strip has moved
const WIDTH = 120;
const HEIGHTS = { OK: 3, STALE: 6, WARN: 9, ERROR: 14 }; // by its height a level is seen without its colour
const KEPT = 600; // moments of it
const NUMBER = /^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(?:[^\d\s.:/-][^\d:/]*)?$/; // with a unit or without
const numberOf = (text) => {
  const number = Number(NUMBER.exec(text ?? "")?.[1] ?? NaN);
  return Number.isFinite(number) ? number : null;
};

// The levels of the last ten minutes, from left to right.
function Strip({ levels, label }) {
  const now = Date.now() / 1000;
  const x = (at) => (Math.max(0, 1 - (now - at) / SPAN) * WIDTH).toFixed(1);
  const shown = (levels || []).filter((_, at) => at + 1 >= levels.length || levels[at + 1][0] > now - SPAN);
  const said = shown.map(([at, level]) => `${known(level).word} ${new Date(at * 1000).toLocaleTimeString("en-GB")}`);
  return html`<svg
    class="strip"
    viewBox="0 0 ${WIDTH} 14"
    preserveAspectRatio="none"
    role="img"
    aria-label=${`${label}, last ten minutes: ${said.slice(-5).join(", ")}`}
  >
    <path class="base" d="M0 13.5H${WIDTH}" />
    ${shown.map(
      ([at, level], index) =>
        html`<rect
          key=${at}
          class=${known(level).tone}
          x=${x(at)}
          width=${Math.max(1, x(shown[index + 1]?.[0] ?? now) - x(at))}
          y=${14 - HEIGHTS[level]}
          height=${HEIGHTS[level]}
        />`,
    )}
  </svg>`;
}

// The parts of a name, as diagnostic_aggregator has them; a part that has one child alone is one with it.
const parts = ({ name, agent }) => name.split(agent ? ": " : /\s*[/:]+\s*/).filter(Boolean);

export function grow(statuses, own) {
  const root = { children: new Map(), worst: "OK", total: 0 };
  for (const [key, one] of statuses) {
    const module = one.module || own;
    const hardware = one.hardware && one.hardware !== module ? [one.hardware] : [];
    let at = root;
    for (const step of [module, ...hardware, ...parts(one)]) {
      at.total += 1;
      if (rank(one.level) > rank(at.worst)) at.worst = one.level;
      if (!at.children.has(step)) at.children.set(step, { children: new Map(), worst: "OK", total: 0, leaves: [] });
      at = at.children.get(step);
    }
    at.leaves.push([key, one]);
  }
  const flat = (label, node) => {
    while (node.children.size === 1 && !node.leaves.length) {
      const [[step, child]] = node.children;
      [label, node] = [`${label} / ${step}`, child];
    }
    const children = [...node.children].map(([step, child]) => flat(step, child));
    if (!children.length && node.leaves.length === 1)
      return { label, leaf: node.leaves[0], worst: node.leaves[0][1].level };
    const leaves = node.leaves.map((leaf) => ({ label, leaf, worst: leaf[1].level }));
    const worst = leaves.reduce((bad, one) => (rank(one.worst) > rank(bad) ? one.worst : bad), node.worst);
    return { label, worst, total: node.total + leaves.length, children: sorted([...leaves, ...children]) };
  };
  return sorted([...root.children].map(([step, child]) => flat(step, child)));
}
const sorted = (list) => list.sort((a, b) => rank(b.worst) - rank(a.worst) || a.label.localeCompare(b.label));

const Leaf = memo(
  ({ label, name, one, chosen }) =>
    html`<li>
      <a class="status" href=${href("diagnostics", name)} aria-current=${chosen ? "true" : undefined}>
        <${Mark}
          state=${one.level}
          word=${one.last ? `${known(one.level).word} (${known(one.last).word})` : undefined}
        />
        <span><strong>${label}</strong> <span class="muted">${one.message}</span></span>
        <${Strip} levels=${one.levels} label=${label} />
      </a>
    </li>`,
);

function Group({ node, chosen, wide, level }) {
  const wants = wide || node.worst !== "OK";
  const [open, toggle] = useState(wants);
  useEffect(() => toggle(wants), [wants]);
  return html`<li>
    <details open=${open} onToggle=${(event) => event.target.open !== open && toggle(event.target.open)}>
      <summary>
        <${Mark} state=${node.worst} word="" /> <strong>${node.label}</strong> <span class="muted">${node.total}</span>
      </summary>
      ${open && html`<${Branch} nodes=${node.children} ...${{ chosen, wide }} level=${level + 1} />`}
    </details>
  </li>`;
}

const leafOf = ({ label, leaf: [name, one] }, chosen) => {
  return { label, name, one, chosen: name === chosen, drawn: Math.floor(Date.now() / REDRAWN) };
};
function Branch({ nodes, chosen, wide, level = 0 }) {
  const [shown, more] = useFirst(nodes);
  return html`<ul class=${level ? "" : "diagnostics"}>
      ${shown.map((node) =>
        node.leaf
          ? html`<${Leaf} key=${`${node.label} ${node.leaf[0]}`} ...${leafOf(node, chosen)} />`
          : html`<${Group} key=${node.label} ...${{ node, chosen, wide, level }} />`,
      )}
    </ul>
    ${more}`;
}

const WHICH = [
  ["OK", "All"],
  ["WARN", "Warnings and worse"],
  ["ERROR", "Errors"],
];

export function Diagnostics({ name, state, connection }) {
  const [least, choose] = useState("OK");
  const filter = useFilter("name, module, hardware or message");
  const own = section(state, "agent").name;
  const told = section(section(state, "detail"), "diagnostics:");
  const all = entries(told, "statuses");
  const fits = ([, one]) =>
    rank(one.level) >= rank(least) &&
    filter.matches(`${one.name} ${one.module || own} ${one.hardware || ""} ${one.message}`);
  const shown = all.filter(fits);
  const levels = section(section(state, "diagnostics"), "levels");
  const { problems = [], refused } = section(state, "diagnostics");
  const present = [...LEVELS].reverse().filter((level) => levels[level]);
  const plural = (level) => (levels[level] > 1 && /ERROR|WARN/.test(level) ? "s" : "");
  const said = present.map((level) => `${levels[level]} ${known(level).word}${plural(level)}`).join(", ");
  return html`<${Page}
    title="Diagnostics"
    kind=${all.length
      ? `${count(all.length)} statuses of all modules: ${said}`
      : "What nodes of all modules say on /diagnostics"}
    aside=${html`<${Choice} label="Least level" value=${least} onChoose=${choose} options=${WHICH} />`}
  >
    ${[...problems, ...(refused ? [refused] : [])].map((text) => html`<p class="failure" key=${text}>${text}</p>`)}
    <div class=${name ? "beside-status chosen" : "beside-status"}>
      <div>
        ${filter.field}
        <${Panel}
          title="Worst of all, last ten minutes"
          aside=${html`<${Strip} levels=${told.worst} label="Worst of all" />`}
        >
          ${shown.length
            ? html`<${Branch} nodes=${grow(shown, own)} chosen=${name} wide=${shown.length <= 40 || filter.typed} />`
            : html`<p class="empty">
                ${all.length
                  ? "No status matches."
                  : "No node has said anything yet; those that do say it once a second."}
              </p>`}<//
        >
      </div>
      ${name &&
      html`<${Chosen} key=${name} ...${{ name, own, state, connection }} one=${section(told, "statuses")[name]} />`}
    </div><//
  >`;
}

const VALUES = [
  ["Key", ([key]) => key],
  ["Value", ([, text]) => text],
  [
    "",
    ([key, text], { fields, toggle, past }) =>
      (past[key] || numberOf(text) !== null) &&
      html`<button
        type="button"
        class="plotted"
        aria-pressed=${String(fields.includes(key))}
        aria-label=${`Plot ${plain(key)}`}
        onClick=${() => toggle(key)}
      >
        Plot
      </button>`,
  ],
];

function Chosen({ name, one, own, state, connection }) {
  const detail = section(section(state, "detail"), `diagnostic:${name}`);
  const values = Object.entries(detail.values || {});
  const [fields, setFields] = useState([]);
  const past = useRef(Object.create(null)); // columns by value, and the moments under an empty name
  const [version, next] = useState(0);
  useEffect(() => {
    const take = (found) => {
      past.current = adopt(found);
      next((n) => n + 1);
    };
    connection.ask("past", { status: name }).then(take, () => {});
  }, []);
  useEffect(() => {
    const columns = past.current;
    const moments = (columns[""] ||= []);
    if (!detail.heard || moments.at(-1) >= detail.heard) return;
    for (const [key, text] of values) if (key && numberOf(text) !== null) columns[key] ||= moments.map(() => null);
    for (const [key, column] of Object.entries(columns)) {
      column.push(key ? numberOf(detail.values[key]) : detail.heard);
      if (column.length > KEPT) column.shift();
    }
    next((n) => n + 1);
  }, [detail.heard]);
  if (!one) return html`<${Panel} title="Status"><p class="empty">There is no such status at present.</p><//>`;
  const module = one.module || own;
  const toggle = (key) => setFields(toggled(fields, key));
  const plotted = fields.filter((key) => past.current[key]);
  const data = ["", ...plotted].map((key) => past.current[key] || []);
  return html`<${Panel} title=${one.name}>
    <p>
      <${Mark} state=${one.level} /> for <${Since} moment=${one.since} /> <strong>${one.message}</strong>
      ${one.last && html`<span class="muted"> (last level: ${known(one.last).word})</span>`}
    </p>
    <${Strip} levels=${one.levels} label=${one.name} />
    <${Facts}
      rows=${[
        ["Module", html`<${ModuleLink} name=${module} />`],
        ["Hardware", one.hardware],
        ["Node", html`<${NodeLink} name=${nodeKey(one.module, one.node)} />`],
        ["Last news", detail.heard && html`<${Since} moment=${detail.heard} text=${(ago) => `${ago} ago`} />`],
      ]}
    />
    <${Table}
      caption="Values"
      columns=${VALUES}
      about=${{ fields, toggle, past: past.current, version }}
      empty="It has no values."
      list=${values}
    />
    ${plotted.length > 0 &&
    html`<${Plot} labels=${plotted} ...${{ data, version }} format=${figure} label=${`Values of ${one.name}`} />`}
    <p class="row"><a class="button" href="#/diagnostics">Close</a></p><//
  >`;
}
