// Scans, grids, paths, poses, clouds and frames of all robots in one map from above, in a frame that is chosen.

import { html, useContext, useEffect, useRef, useState } from "../markup.js";
import { duration, hertz } from "../format.js";
import { entries, section } from "../state.js";
import { AsPanel, Check, Failure, IconButton, Mark, Page, Panel, Select, useTick } from "../parts.js";
import { isOld } from "../fresh.js";
import { ink, onTheme } from "../theme.js";
import { store, stored } from "../storage.js";
import { gestures } from "../viewport.js";
import { Frames, isLate } from "../frames.js";
import { LAYERS, Layer, View, bounds, drawFrames, drawGround, drawLayer, drawScale, moduleColour } from "../layers.js";
import { now, transformTopics, useFrames } from "./tf.js";

const MOST = 12; // layers: a page may watch 16 topics, of which some are tf's
const KEPT = "rmpa.map"; // in the browser: { fixed, follow, frames, on: { topic: true or false } }
const PREFERRED = ["map", "world", "odom"];
const GATHER = 100; // milliseconds in which messages are drawn together
const OLD = 2; // seconds after which the age of what came once is told
const SETTLED = 1; // seconds in which transforms come that belong to a message
const LASTING = ["grid", "path"];
const NO_FRAMES = new Frames();
const HELP = "Drag or arrow keys move it, the wheel, two fingers or + and − zoom, 0 shows all.";

// What is shown at first: what is small, and the map itself.
const byDefault = (topic, kind) => (kind === "grid" ? /(^|\/)map$/.test(topic) : kind !== "cloud" && kind !== "poses");

// As a panel it is given what is kept of it.
export function MapPage(props) {
  const [kept, set] = useState(() => stored(KEPT));
  const keep = (news) => {
    const next = { ...kept, ...news };
    store(KEPT, next);
    set(next);
  };
  return html`<${Page} title="Map" kind="From above: x to the right, y up"
    ><${MapView} ...${props} kept=${props.kept ?? kept} keep=${props.keep ?? keep}
  /><//>`;
}

function MapView({ state, connection, kept, keep }) {
  const map = useRef();
  map.current ||= new MapCanvas();
  const own = section(state, "agent").name;
  const topics = entries(state, "topics").filter(([, one]) => one.type in LAYERS);
  const on = (name, kind) => kept.on?.[name] ?? byDefault(name, kind);
  const wanted = topics.filter(([name, one]) => on(name, LAYERS[one.type])).map(([name]) => name);
  const shown = wanted.slice(0, MOST);
  const { frames, failure } = useFrames(connection, state, () => map.current.draw());
  useTick(0.5);
  const inUse = new Set(map.current.all.map((layer) => layer.frame).filter(Boolean));
  const names = [...new Set([...frames.names, ...inUse])].sort();
  const fixed = names.includes(kept.fixed) ? kept.fixed : chosen(frames, names, inUse);
  const live = connection.phase === "open";
  const isThere = (layer) => live && (section(state, "topics")[layer.topic]?.from || []).length > 0;
  map.current.show({ frames, fixed, own, shown, isThere, live, follow: kept.follow, axes: kept.frames !== false });
  const toggle = (name, value) => keep({ on: { ...kept.on, [name]: value } });
  const list = html`<div class="form">
    <${Failure} failure=${failure} />
    <div class="row">
      <${Select}
        label="Fixed frame"
        value=${fixed}
        names=${names.length ? names : [["", "no frame is known"]]}
        onChange=${(name) => keep({ fixed: name })}
      />
      <${Select}
        label="Keep in the middle"
        value=${kept.follow ?? ""}
        names=${[["", "–"], ...names]}
        onChange=${(name) => keep({ follow: name })}
      />
    </div>
    <ul class="layers">
      ${topics.map(
        ([name, one]) =>
          html`<${Row}
            key=${name}
            ...${{ name, connection, own, live, map: map.current, type: one.type, isThere }}
            off=${!shown.includes(name)}
            checked=${wanted.includes(name)}
            toggle=${(value) => toggle(name, value)}
          />`,
      )}
      <li>
        <${Check}
          label=${html`Frames of tf
            <span class="muted">${transformTopics(state).join(", ") || "no topic has them"}</span>`}
          checked=${kept.frames !== false}
          onChange=${(value) => keep({ frames: value })}
        />
      </li>
    </ul>
    ${!topics.length &&
    html`<p class="empty">No topic has a type that is drawn: ${Object.keys(LAYERS).join(", ")}.</p>`}
    ${wanted.length > MOST &&
    html`<p class="empty">${MOST} layers are drawn at one time: switch one off to see another.</p>`}
  </div>`;
  return html`<div class="mapping">
    <div class="map">
      <${Surface} map=${map.current} fixed=${fixed} layers=${shown.length} />
    </div>
    ${useContext(AsPanel)
      ? html`<details>
          <summary>Layers and frames</summary>
          ${list}
        </details>`
      : html`<${Panel}>${list}<//>`}
  </div>`;
}

// One topic by itself, in its own frame: tf is not asked.
export function TopicMap({ state, connection, topic, type }) {
  const map = useRef();
  map.current ||= new MapCanvas();
  useTick(0.5);
  const own = section(state, "agent").name,
    live = connection.phase === "open";
  const isThere = () => live && (section(state, "topics")[topic]?.from || []).length > 0;
  const fixed = map.current.all[0]?.frame ?? "";
  map.current.show({ frames: NO_FRAMES, fixed, own, isThere, live, axes: false });
  return html`<div>
    <div class="map"><${Surface} map=${map.current} fixed=${fixed} layers=${1} /></div>
    <ul class="layers">
      <${Row} ...${{ name: topic, type, connection, own, live, map: map.current, isThere }} />
    </ul>
  </div>`;
}

function chosen(frames, names, inUse) {
  const known = PREFERRED.find((name) => names.includes(name));
  return known ?? frames.roots[0] ?? [...inUse][0] ?? "";
}

// One topic: its switch, and what is said of the layers of its nodes. It watches the topic while it is on.
function Row({ name, type, connection, own, live, map, checked, off, toggle, isThere }) {
  const [failure, setFailure] = useState(null);
  const kind = LAYERS[type];
  useEffect(() => {
    setFailure(null);
    if (off) return undefined;
    const rate = kind === "cloud" ? 4 : kind === "scan" ? 10 : 5;
    const end = connection.watch({ topic: name, how: "map", rate }, (message) => {
      if (message.op === "failed") setFailure(message);
      else if (message.op === "layer") map.take(name, message);
      else if (message.op === "beat") map.beats.set(name, message.after);
    });
    return () => {
      end();
      map.forget(name);
    };
  }, [name, off]);
  const layers = map.of(name);
  return html`<li>
    ${toggle &&
    html`<${Check}
      label=${html`<span class="mono">${name}</span> <span class="muted">${kind}</span>`}
      checked=${checked}
      onChange=${toggle}
    />`}
    ${!off && !layers.length && !failure && html`<p class="muted about">Waiting for a message …</p>`}
    ${layers.map((layer) => html`<${About} key=${layer.source} ...${{ layer, own, live, map, isThere }} />`)}
    <${Failure} failure=${failure} />
  </li>`;
}

function About({ layer, own, live, map, isThere }) {
  const { head } = layer;
  const old = map.isOld(layer),
    age = now() - layer.heard;
  const thinned = head.every > 1 && (head.cells ? `${head.every} × ${head.every} as one` : `1 of ${head.every} drawn`);
  const rate = !old && layer.rate && hertz(layer.rate);
  const said = [layer.frame, layer.said, thinned, rate].filter(Boolean).join(" · ");
  return html`<p class="about">
    <svg viewBox="0 0 10 10" aria-hidden="true"><rect width="10" height="10" rx="2" fill=${map.colour(layer)} /></svg>
    <span class="whole">${layer.module || own}</span><span class="muted"> · ${said}</span>
    ${old
      ? html` <${Mark}
          state="STALE"
          word=${live && !isThere(layer) ? `its publisher has gone, ${duration(age)}` : duration(age)}
        />`
      : layer.count === 1 && age > OLD && html`<span class="muted"> · ${duration(age)} old</span>`}
    ${layer.problem && html`<br /><${Mark} state="WARN" word="" />${" "}${layer.problem}`}
  </p>`;
}

// The canvas with all that moves it.
function Surface({ map, fixed, layers }) {
  const canvas = useRef(),
    place = useRef();
  useEffect(() => map.attach(canvas.current, place.current), []);
  const label = `Map from above in the frame ${fixed || "that is not known"}, ${layers} layers. ${HELP}`;
  return html`<canvas class="ground" ref=${canvas} tabindex="0" role="application" aria-label=${label}></canvas>
    <div class="over">
      <${IconButton} label="Zoom in (+)" press=${() => map.zoom(1.5)}>+<//>
      <${IconButton} label="Zoom out (−)" press=${() => map.zoom(1 / 1.5)}>−<//>
      <${IconButton} label="Show all (0)" press=${() => map.fit(true)}>
        <svg viewBox="0 0 20 20" aria-hidden="true"><path d="M3 7V3h4M13 3h4v4M17 13v4h-4M7 17H3v-4" /></svg
      ><//>
    </div>
    <span class="place mono" ref=${place}></span>`;
}

// Keeps the layers and draws them, apart from the page's own drawing.
class MapCanvas {
  constructor() {
    this.view = new View();
    this.layers = new Map();
    this.beats = new Map(); // of each topic, the seconds after which it is old
    this.modules = []; // in the order in which they came: a module keeps its colour
    this.shown = { shown: [], fixed: "", isThere: () => true, own: "" };
    this.moved = false;
  }

  get all() {
    return [...this.layers.values()];
  }
  of = (topic) => this.all.filter((layer) => layer.topic === topic);
  // What came once, as a latched map, is old when its publisher has gone.
  isOld = ({ topic, source, heard }) =>
    !this.shown.isThere({ topic, source }) || isOld(heard * 1000, this.beats.get(topic));
  forget(topic) {
    for (const [key, layer] of this.layers) if (layer.topic === topic) this.layers.delete(key);
    this.draw();
  }

  take(topic, { head, body }) {
    const key = `${topic} ${head.source}`;
    if (!this.layers.has(key)) this.layers.set(key, new Layer(topic, head.source));
    const layer = this.layers.get(key);
    Promise.resolve(layer.take(head, body, now())).then(
      () => this.draw(),
      () => (layer.problem = "the picture cannot be decoded"),
    );
  }

  colourOf(module) {
    if (!this.modules.includes(module)) this.modules.push(module);
    return moduleColour(this.modules.indexOf(module));
  }
  colour = (layer) => this.colourOf(layer.module || this.shown.own);

  show(shown) {
    const before = this.shown;
    this.shown = shown;
    if (before.fixed !== shown.fixed || before.axes !== shown.axes || before.live !== shown.live) this.draw();
    if (before.fixed !== shown.fixed) this.moved = false;
  }

  attach(canvas, place) {
    Object.assign(this, { canvas, place });
    canvas.view = this.view; // for the console and for tests
    const gone = gestures(canvas, () => this);
    const sizes = new ResizeObserver(() => this.draw(true));
    sizes.observe(canvas);
    const themes = onTheme(() => this.draw());
    this.old = setInterval(() => this.draw(), 1000); // what is old becomes grey
    this.draw(true);
    return () => {
      gone();
      sizes.disconnect();
      themes();
      clearInterval(this.old);
      this.canvas = null;
    };
  }

  zoom = (...how) => this.move("zoom", how);
  pan = (...how) => this.move("pan", how);
  move(what, how) {
    this.view[what](...how);
    this.moved = true;
    this.draw(true);
  }
  point(px, py) {
    const [x, y] = this.view.from(px, py);
    this.place.textContent = `${x.toFixed(2)}, ${y.toFixed(2)} m`;
  }

  // A measurement stays where its frame was at its stamp, as soon as the transforms around it have come. A grid or
  // a path is of its frame as it is now.
  poseOf(layer, frames, fixed) {
    const { head, kept } = layer,
      lasts = LASTING.includes(layer.kind);
    if (kept?.head === head && kept.fixed === fixed && kept.pose && now() - layer.heard > SETTLED && !lasts)
      return kept;
    const stamp = lasts ? 0 : head.stamp;
    layer.kept = { head, fixed, ...frames.lookup(fixed, layer.frame, stamp, layer.module) };
    return layer.kept;
  }

  // What is shown now, each layer with its pose in the fixed frame, or why there is none.
  placed() {
    const { frames, fixed } = this.shown,
      found = [];
    for (const layer of this.all) {
      if (!layer.head) continue;
      const { pose, problem, edges } = this.poseOf(layer, frames, fixed);
      const late = (edges || []).find((edge) => isLate(edge, now()));
      layer.problem = problem ?? (late && `the transform of ${late.child} is ${duration(now() - late.heard)} old`);
      if (pose) found.push({ layer, pose, old: Boolean(late) || this.isOld(layer) });
    }
    const order = Object.values(LAYERS);
    return found.sort((a, b) => order.indexOf(a.layer.kind) - order.indexOf(b.layer.kind));
  }

  fit(asked) {
    const box = bounds(this.placed());
    if (asked) this.moved = false;
    if (box) this.view.fit(box);
    if (asked) this.draw(true);
  }

  // In the next frame; news are gathered.
  draw(at_once = false) {
    if (this.waits && !at_once) return;
    clearTimeout(this.waits);
    const paint = () => requestAnimationFrame(() => this.paint());
    this.waits = setTimeout(paint, at_once ? 0 : GATHER);
  }

  paint() {
    this.waits = 0;
    const { canvas, view } = this;
    if (!canvas?.clientWidth) return;
    const ratio = Math.min(2, devicePixelRatio || 1);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio))
      Object.assign(canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
    Object.assign(view, { width, height });
    const { frames, fixed, follow } = this.shown;
    const middle = follow && frames.lookup(fixed, follow).pose;
    const placed = this.placed(),
      drawn = `${placed.length} ${fixed}`;
    if (!this.moved && this.drawn !== drawn) this.fit(false);
    this.drawn = drawn;
    if (middle) [view.x, view.y] = middle;
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const colours = Object.fromEntries(
      ["line", "text", "muted", "idle", "panel"].map((name) => [name, ink(`--${name}`)]),
    );
    drawGround(context, view, colours);
    for (const { layer, pose, old } of placed)
      drawLayer(context, view, layer, pose, { colours, colour: this.colour(layer), old, ratio });
    if (this.shown.axes) drawFrames(context, view, this.axes(), colours);
    drawScale(context, view, colours);
  }

  axes() {
    const { frames, fixed, own, live } = this.shown;
    return frames.names.flatMap((name) => {
      const { pose, edges } = frames.lookup(fixed, name);
      if (!pose) return [];
      const old = !live || edges.some((edge) => isLate(edge, now()));
      const sender = frames.edge(name)?.source ?? "";
      return [{ name, pose, old, colour: this.colourOf(Frames.module(sender) || own) }];
    });
  }
}
