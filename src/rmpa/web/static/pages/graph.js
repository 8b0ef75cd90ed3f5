// The graph of nodes and topics as rqt_graph draws it: nodes in a lane for each module, topics between them.

import { html, memo, useEffect, useLayoutEffect, useRef, useState } from "../markup.js";
import { count, hertz } from "../format.js";
import { section } from "../state.js";
import { useAgain } from "../asking.js";
import { download } from "../storage.js";
import { gestures } from "../viewport.js";
import { curve, layout } from "../layout.js";
import { Check, Choice, Failure, Mark, Page, Panel, Select } from "../parts.js";
import { Table, useFilter } from "../lists.js";
import { Link, NodeLink, href } from "../links.js";
import { isData } from "./topics.js";

const PERIOD = 2; // seconds between two questions for a graph that may have changed
const LETTERS = 26;
const NAMED = 170; // between columns, where edges have names
const STACK = 4; // topics of the same nodes that are named in one box; the others are counted
const LINE = 17;
const DEBUG = new RegExp(
  "^/(rosout|rosout_agg|clock|tf|tf_static|statistics|diagnostics|rmpa/.*|(connected_clients|client_count))$" +
    "|/(parameter_descriptions|parameter_updates|bond|holder)$",
);
const TOOLS = /^\/(rmpa|rosout|rmpa_[a-z]+(_\d+)*|rostopic_\d+_\d+|rqt_gui_py_node_\d+|rosbag_\d.*)$/;

// A node of the graph and the module that it is of; a peer's node stands in this graph as its proxy /rmpa/PEER/node.
const PROXY = /^\/rmpa\/([^/]+)(\/.+)$/;
export const nodeOf = (name, own) => {
  const [, module = own, node = name] = PROXY.exec(name) || [];
  return { module, node };
};
export const short = (name, most = LETTERS) =>
  name.length <= most ? name : `${name.slice(0, most / 2 - 1)}…${name.slice(-most / 2)}`;

// What is drawn of the graph: { nodes, topics } by name, where each has its edges.
export function choose(topics, { text, module, namespace, debug, leaves, only, own, state }) {
  const nodes = new Map(),
    shown = new Map();
  const hidden = (name) => !debug && (TOOLS.test(name) || TOOLS.test(nodeOf(name, own).node));
  for (const [name, [type, publishers, subscribers]] of Object.entries(topics)) {
    if (!debug && (DEBUG.test(name) || !isData(name, state))) continue;
    const from = publishers.filter((node) => !hidden(node)),
      to = subscribers.filter((node) => !hidden(node));
    if (!from.length && !to.length) continue;
    if (!leaves && (!from.length || !to.length)) continue;
    shown.set(name, { name, type, from, to });
    for (const node of [...from, ...to]) if (!nodes.has(node)) nodes.set(node, { name: node, ...nodeOf(node, own) });
  }
  const near = new Map(
    [...nodes.keys(), ...[...shown.keys()].map((name) => `topic ${name}`)].map((id) => [id, new Set()]),
  );
  for (const { name, from, to } of shown.values())
    for (const node of [...from, ...to]) {
      near.get(`topic ${name}`).add(node);
      near.get(node).add(`topic ${name}`);
    }
  const keep = (core, steps) => {
    for (let step = 0; step < steps; step++)
      for (const id of [...core]) for (const next of near.get(id) || []) core.add(next);
    for (const name of [...nodes.keys()]) if (!core.has(name)) nodes.delete(name);
    for (const name of [...shown.keys()]) if (!core.has(`topic ${name}`)) shown.delete(name);
    for (const topic of shown.values()) {
      topic.from = topic.from.filter((node) => core.has(node));
      topic.to = topic.to.filter((node) => core.has(node));
    }
  };
  if (only && near.has(only)) keep(new Set([only]), only.startsWith("topic ") ? 1 : 2);
  if (text || module || namespace) {
    const within = (name) => !namespace || name === namespace || name.startsWith(`${namespace}/`);
    const fits = (name, owner) =>
      name.toLowerCase().includes(text) && within(nodeOf(name, own).node) && (!module || owner === module);
    const core = [...nodes.values()].filter((one) => fits(one.name, one.module)).map((one) => one.name);
    const told = [...shown.values()].filter((one) => !module && fits(one.name, ""));
    keep(new Set([...core, ...told.map((one) => `topic ${one.name}`)]), 1);
  }
  return { nodes, topics: shown };
}

// The boxes and edges: topics of the same nodes are one box, or with `merged` only edges from node to node.
export function shapes({ nodes, topics }, own, merged) {
  const vertices = [...nodes.values()].map((one) => ({
    id: one.name,
    kind: "node",
    lane: one.module,
    lines: [short(one.node)],
    w: Math.max(80, short(one.node).length * 8 + 36),
    h: 36,
  }));
  const edges = new Map();
  const join = (from, to, name) => {
    const key = `${from}\n${to}`;
    if (!edges.has(key)) edges.set(key, { from, to, topics: [], named: merged });
    edges.get(key).topics.push(name);
  };
  const stacks = new Map();
  for (const one of [...topics.values()].sort((a, b) => (a.name < b.name ? -1 : 1))) {
    if (merged) {
      for (const from of one.from) for (const to of one.to) join(from, to, one.name);
      continue;
    }
    const key = JSON.stringify([[...one.from].sort(), [...one.to].sort()]);
    if (!stacks.has(key)) stacks.set(key, []);
    stacks.get(key).push(one);
  }
  for (const stack of stacks.values()) {
    const [first] = stack;
    const id = `topic ${first.name}`;
    const lines = stack.slice(0, stack.length > STACK ? STACK - 1 : STACK).map((one) => short(one.name));
    if (stack.length > lines.length) lines.push(`… ${stack.length - lines.length} more`);
    const modules = [...first.from, ...first.to].map((node) => nodeOf(node, own).module);
    const w = Math.max(60, ...lines.map((line) => line.length * 7.4 + 20));
    vertices.push({
      id,
      kind: "topic",
      lane: modules[0],
      lines,
      topics: stack.map((one) => one.name),
      w,
      h: lines.length * LINE + 10,
    });
    for (const { name } of stack) {
      for (const node of first.from) join(node, id, name);
      for (const node of first.to) join(id, node, name);
    }
  }
  return { vertices, edges: [...edges.values()] };
}

// The state of an edge by its topics: trouble, flowing as fast as the fastest, or not known.
function flow(names, topics) {
  const told = names.map((name) => topics[name] || {});
  const rate = Math.max(0, ...told.map((one) => one.rate || 0));
  return { tone: told.some((one) => one.problem) ? "bad" : rate ? "flows" : "", rate: rate ? hertz(rate) : "" };
}

function useGraph(connection) {
  const [graph, set] = useState({});
  const has = useRef("");
  useAgain(connection.phase === "open", PERIOD, "", (wanted) =>
    connection.ask("graph", { has: has.current }).then(
      (found) => {
        if (!wanted()) return;
        has.current = found.digest;
        set((before) => (found.topics ? found : before.failure ? { ...before, failure: undefined } : before));
      },
      (failure) => wanted() && set((before) => ({ ...before, failure })),
    ),
  );
  return graph;
}

const VIEWS = [
  ["both", "Nodes and topics"],
  ["nodes", "Nodes only"],
];
// First parts of names that several nodes and topics have in common.
function namespaces(topics, own) {
  const counts = new Map();
  const names = new Set(Object.entries(topics).flatMap(([name, [, from, to]]) => [name, ...from, ...to]));
  for (const name of names) {
    const [, first, more] = nodeOf(name, own).node.split("/");
    if (more) counts.set(`/${first}`, (counts.get(`/${first}`) || 0) + 1);
  }
  return [...counts.keys()].sort();
}

export function GraphPage({ name, state, connection }) {
  const [options, set] = useState({ view: "both", debug: false, leaves: true, module: "", namespace: "" });
  const choice = (option) => (value) => set({ ...options, [option]: value });
  const [focused, focus] = useState(false);
  const filter = useFilter("name");
  const memory = useRef({});
  const graph = useGraph(connection);
  const own = section(state, "agent").name;
  const topics = graph.topics || {};
  const wanted = { ...options, text: filter.typed, only: focused && name, own };
  const key = JSON.stringify([graph.digest, wanted]);
  if (memory.current.key !== key && graph.topics) {
    const merged = options.view === "nodes";
    const found = choose(topics, { ...wanted, state });
    const made = shapes(found, own, merged);
    const lanes = [...new Set([own, ...made.vertices.map((each) => each.lane).sort()])];
    const placed = layout(made.vertices, made.edges, lanes, memory.current.drawn, merged ? NAMED : undefined);
    memory.current = { key, chosen: found, ...made, drawn: placed };
  }
  const { chosen, vertices = [], edges = [], drawn } = memory.current;
  const ends = Object.values(topics).flatMap(([, from, to]) => [...from, ...to]);
  const modules = [...new Set(ends.map((node) => nodeOf(node, own).module))].sort();
  const filters = [
    ["module", "Module", modules],
    ["namespace", "Namespace", namespaces(topics, own)],
  ];
  return html`<${Page}
    title="Graph"
    kind=${chosen
      ? `${count(chosen.nodes.size)} nodes and ${count(chosen.topics.size)} topics of all modules`
      : "Asking …"}
    aside=${html`<${Choice} label="What is drawn" value=${options.view} onChoose=${choice("view")} options=${VIEWS} />`}
  >
    <div class="row filter-row">
      ${filter.field}
      ${filters.map(
        ([option, label, names]) =>
          html`<${Select}
            key=${option}
            look="pick"
            label=${label}
            value=${options[option]}
            names=${[["", "all"], ...names]}
            onChange=${choice(option)}
          />`,
      )}
      <${Check} label="Debug topics" checked=${options.debug} onChange=${choice("debug")} />
      <${Check} label="Topics with one end" checked=${options.leaves} onChange=${choice("leaves")} />
    </div>
    <${Failure} failure=${graph.failure} />
    ${graph.hidden > 0 && html`<p class="empty">The server leaves out ${count(graph.hidden)} further topics.</p>`}
    ${chosen &&
    (vertices.length
      ? html`<div class="beside-graph">
          <${Panel}><${Drawing} ...${{ drawn, vertices, edges, name, state, own }} /><//>
          ${name
            ? html`<${About} name=${name} chosen=${chosen} vertices=${vertices} own=${own} state=${state}>
                <button type="button" aria-pressed=${String(focused)} onClick=${() => focus(!focused)}>
                  ${focused ? "Show all" : "Only it and its neighbours"}
                </button>
                <a class="button" href="#/graph">Close</a>
              <//>`
            : html`<${Panel} title="Nothing is chosen"
                ><p class="muted">Press a node or a topic: its neighbours stand out, and it is described here.</p><//
              >`}
        </div>`
      : html`<p class="empty">Nothing is like that: choose less, or show debug topics.</p>`)}
    ${chosen && html`<${AsTable} chosen=${chosen} state=${state} />`}<//
  >`;
}

const FACTOR = 1.25;
const LEGIBLE = 1.5; // units of the drawing a pixel: smaller letters are not read
const ALL = "all"; // is shown, however small

// Where one looks: the upper left corner, and how many units of the drawing a pixel has; all of it until it is moved.
function useView(box, drawn) {
  const [moved, set] = useState(null);
  const [{ w, h }, measure] = useState({ w: 800, h: 500 });
  useLayoutEffect(() => {
    const look = () => measure({ w: box.current.clientWidth, h: box.current.clientHeight });
    const observer = new ResizeObserver(look);
    look();
    observer.observe(box.current);
    return () => observer.disconnect();
  }, []);
  const wide = Math.min(Math.max(0.6, drawn.width / w), LEGIBLE);
  const scale = Math.min(Math.max(wide, drawn.height / h), LEGIBLE); // what is larger is panned
  useLayoutEffect(() => {
    box.current.style.height = `min(72vh, ${Math.max(240, Math.ceil(drawn.height / wide))}px)`; // no higher than it is
  }, [drawn.height, wide]);
  const middle = (low, all) => Math.min(0, (all - low) / 2);
  const seen = (one) => ({ scale: one, x: middle(w * one, drawn.width), y: middle(h * one, drawn.height) });
  const now = moved === ALL ? seen(Math.max(scale, drawn.width / w, drawn.height / h)) : moved || seen(scale);
  const change = (next) => set((before) => next(before && before !== ALL ? before : now));
  const zoom = (factor, px = w / 2, py = h / 2) =>
    change((at) => {
      const next = Math.max(0.2, Math.min(8, at.scale / factor));
      return { scale: next, x: at.x + px * (at.scale - next), y: at.y + py * (at.scale - next) };
    });
  const pan = (dx, dy) => change((at) => ({ ...at, x: at.x - dx * at.scale, y: at.y - dy * at.scale }));
  const show = ({ x, y }) =>
    change((at) => {
      const inside = (spot, low, length) =>
        Math.min(Math.max(low, spot + (60 - length) * at.scale), spot - 60 * at.scale);
      return { ...at, x: inside(x, at.x, w), y: inside(y, at.y, h) };
    });
  const viewBox = `${now.x} ${now.y} ${w * now.scale} ${h * now.scale}`;
  return { viewBox, left: now.x, zoom, pan, show, fit: () => set(ALL) };
}

const MARKER = { viewBox: "0 0 8 8", refX: 7, refY: 4, markerWidth: 9, markerHeight: 9 };

function Drawing({ drawn, vertices, edges, name, state, own }) {
  const box = useRef();
  const view = useView(box, drawn);
  const step = ({ target }, ...way) => {
    const here = target.closest("[data-id]")?.dataset.id;
    if (here) neighbour(drawn, vertices, here, way, box.current);
    return here;
  };
  const latest = useRef(view);
  latest.current = { ...view, step };
  useEffect(() => gestures(box.current, () => latest.current), []);
  const topics = section(state, "topics");
  useEffect(() => drawn.at.has(name) && view.show(drawn.at.get(name)), [name, drawn]);
  const selected = (edge) => edge.from === name || edge.to === name;
  const lit = new Set([name, ...edges.filter(selected).flatMap((edge) => [edge.from, edge.to])]);
  return html`<div class="row tools-row">
      <button type="button" onClick=${() => view.zoom(FACTOR)} aria-label="Larger (+)">+</button>
      <button type="button" onClick=${() => view.zoom(1 / FACTOR)} aria-label="Smaller (−)">−</button>
      <button type="button" onClick=${view.fit}>Whole</button>
      <button type="button" onClick=${() => save(box.current, drawn)}>Save as SVG</button>
      ${["flows", "bad"].map(
        (tone) =>
          html`<span key=${tone} class="mark legend-edge ${tone}"
            ><svg viewBox="0 0 26 16"><path d="M1 8h24" /></svg>${tone === "bad" ? "a problem" : "flows"}</span
          >`,
      )}
      <span class="muted">Drag or arrows move, wheel, pinch or + − zoom, 0 shows all.</span>
    </div>
    <svg
      ref=${box}
      class=${drawn.at.has(name) ? "graph dims" : "graph"}
      viewBox=${view.viewBox}
      tabindex="0"
      role="group"
      aria-label="The graph; the table below says the same"
    >
      <defs>
        <marker id="tip" markerUnits="userSpaceOnUse" orient="auto" ...${MARKER}>
          <path class="tip" d="M0 .5 8 4 0 7.5Z" />
        </marker>
      </defs>
      ${drawn.lanes.map(
        (lane) =>
          html`<g key=${lane.name}>
            <rect class="lane" x="0" y=${lane.y} width=${drawn.width} height=${lane.h} rx="10" />
            <text class="lane-name" x=${12 + Math.max(0, view.left)} y=${lane.y + 17}>${lane.name}</text>
          </g>`,
      )}
      ${drawn.paths.map(
        (path) =>
          html`<${Edge}
            key=${`${path.from} ${path.to}`}
            path=${path}
            ...${flow(path.topics, topics)}
            lit=${selected(path)}
          />`,
      )}
      ${vertices.map(
        (one) =>
          html`<${Vertex}
            key=${one.id}
            ...${{ one, own }}
            at=${drawn.at.get(one.id)}
            lit=${lit.has(one.id)}
            chosen=${one.id === name}
            ...${flow(one.topics || [], topics)}
            view=${latest}
          />`,
      )}
    </svg>`;
}

const Edge = memo(({ path, tone, rate, lit }) => {
  const { topics, points } = path;
  const middle = points[Math.floor(points.length / 2)],
    before = points[Math.floor((points.length - 1) / 2)];
  const label = topics.length > 1 ? `${topics.length} topics` : short(topics[0], 22);
  return html`<g class="edge ${tone} ${lit ? "lit" : ""}">
    <title>${topics.join(", ")}${rate && `: ${rate}`}</title>
    <path d=${curve(points)} marker-end="url(#tip)" />
    ${path.named && html`<text x=${(middle.x + before.x) / 2} y=${(middle.y + before.y) / 2 - 5}>${label}</text>`}
  </g>`;
});

const Vertex = memo(({ one, at, lit, chosen, own, tone, rate, view }) => {
  const { x, y } = at;
  const node = one.kind === "node";
  const whose = one.lane === own ? "" : `, of ${one.lane}`;
  const said = node ? `Node ${one.id}${whose}` : `Topic ${one.topics.join(", ")}${rate && `, ${rate}`}`;
  return html`<a
    class="vertex ${one.kind} ${tone} ${lit ? "lit" : ""} ${chosen ? "chosen" : ""}"
    href=${href("graph", one.id)}
    data-id=${one.id}
    aria-label=${said}
    aria-current=${chosen ? "true" : undefined}
    draggable="false"
    onFocus=${(event) => event.currentTarget.matches(":focus-visible") && view.current.show(at)}
  >
    <title>${said}</title>
    <rect x=${x - one.w / 2} y=${y - one.h / 2} width=${one.w} height=${one.h} rx=${node ? one.h / 2 : 4} />
    ${one.lines.map(
      (line, index) =>
        html`<text key=${index} x=${x} y=${y + 5 + (index - (one.lines.length - 1) / 2) * LINE}>${line}</text>`,
    )}
  </a>`;
});

// The nearest vertex in the direction of an arrow key has the focus.
function neighbour(drawn, vertices, from, [dx, dy], svg) {
  const here = drawn.at.get(from);
  const far = ({ id }) => {
    const { x, y } = drawn.at.get(id);
    const along = (x - here.x) * dx + (y - here.y) * dy;
    const aside = Math.abs((x - here.x) * dy) + Math.abs((y - here.y) * dx);
    return along > 1 ? along + 2 * aside : Infinity;
  };
  const next = vertices.reduce((best, one) => (far(one) < far(best) ? one : best), { id: from });
  [...svg.querySelectorAll("[data-id]")].find((each) => each.dataset.id === next.id)?.focus();
}

const LOOKS = "fill stroke stroke-width stroke-dasharray opacity font-size font-family font-weight text-anchor".split(
  " ",
);

// A file of the whole drawing with the colours that it has now.
function save(svg, drawn) {
  const copy = svg.cloneNode(true);
  const all = (root) => root.querySelectorAll("rect, path, text");
  const to = all(copy);
  const give = (one, values) => Object.entries(values).forEach(([key, value]) => one.setAttribute(key, value));
  all(svg).forEach((each, at) => {
    const style = getComputedStyle(each);
    give(to[at], Object.fromEntries(LOOKS.map((look) => [look, style.getPropertyValue(look)])));
  });
  const [width, height] = [drawn.width + 20, drawn.height + 20];
  give(copy, { xmlns: "http://www.w3.org/2000/svg", viewBox: `-10 -10 ${width} ${height}`, width, height });
  for (const each of copy.querySelectorAll("a")) each.removeAttribute("href");
  const ground = document.createElementNS("http://www.w3.org/2000/svg", "rect");
  give(ground, { x: -10, y: -10, width, height, fill: getComputedStyle(svg).backgroundColor });
  copy.prepend(ground);
  download("graph.svg", "image/svg+xml", new XMLSerializer().serializeToString(copy));
}

const Names = ({ names, page }) =>
  names.map(
    (name, at) =>
      html`${at > 0 && ", "}${page ? html`<${Link} page=${page} name=${name} />` : html`<${NodeLink} name=${name} />`}`,
  );
const Part = ({ title, ...names }) =>
  html`<h3>${title}</h3>
    <p><${Names} ...${names} /></p>`;

function About({ name, chosen, vertices, own, state, children }) {
  const topics = section(state, "topics");
  const node = chosen.nodes.get(name);
  const stack = vertices.find((each) => each.id === name)?.topics || [];
  const first = chosen.topics.get(stack[0]);
  const of = (end) => [...chosen.topics.values()].filter((one) => one[end].includes(name)).map((one) => one.name);
  if (!node && !first) return html`<${Panel} title="It is not drawn at present"><p class="row">${children}</p><//>`;
  return html`<${Panel}
    title=${node ? "Node" : stack.length > 1 ? `${stack.length} topics of the same nodes` : "Topic"}
  >
    ${node
      ? html`<p>
            <${NodeLink} name=${name} />${node.module !== own &&
            html` <span class="muted">${node.node} of ${node.module}</span>`}
          </p>
          <${Part} title="Publishes" page="topic" names=${of("from")} />
          <${Part} title="Subscribes" page="topic" names=${of("to")} />`
      : html`${stack.map(
            (each) =>
              html`<p key=${each}>
                <${Link} page="topic" name=${each} />${" "}
                <span class="muted">${chosen.topics.get(each)?.type} ${hertz(topics[each]?.rate)}</span>
                ${topics[each]?.problem && html`<${Mark} state="WARN" word=${topics[each].problem} />`}
              </p>`,
          )} <${Part} title="Publishers" names=${first.from} /><${Part} title="Subscribers" names=${first.to} />`}
    <p class="row">${children}</p><//
  >`;
}

const COLUMNS = [
  ["Topic", (one) => html`<${Link} page="topic" name=${one.name} />`],
  ["~Type", (one) => one.type],
  ["#Rate", (one, { topics }) => hertz(topics[one.name]?.rate)],
  ["Publishers", (one) => html`<${Names} names=${one.from} />`],
  ["Subscribers", (one) => html`<${Names} names=${one.to} />`],
];
const AsTable = ({ chosen, state }) =>
  html`<${Panel} title="As a table"
    ><${Table}
      caption="Topics of the graph"
      columns=${COLUMNS}
      about=${{ topics: section(state, "topics") }}
      list=${[...chosen.topics.values()].sort((a, b) => (a.name < b.name ? -1 : 1))}
  /><//>`;
