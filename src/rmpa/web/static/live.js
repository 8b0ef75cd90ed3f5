// Live messages of one topic: the newest value, plots of any number in it, images, and what a map has layers of.

import { html, useLayoutEffect, useRef, useState } from "./markup.js";
import { bandwidth, bytes, clock, hertz } from "./format.js";
import { Fresh, useOld, useWatch } from "./fresh.js";
import { Choice, Failure, Mark, Panel } from "./parts.js";
import { section } from "./state.js";
import { Plot, append, figure, toggled } from "./plot.js";
import { LAYERS } from "./layers.js";
import { TopicMap } from "./pages/map.js";
import { MessageTree } from "./tree.js";

export const IMAGES = ["sensor_msgs/Image", "sensor_msgs/CompressedImage"];
const SWITCH = [
  [false, "Off"],
  [true, "On"],
];

export function Live({ connection, topic, type, state }) {
  const [on, setOn] = useState(false);
  const [old, setOld] = useState(false);
  const [fields, setFields] = useState([]);
  const view = IMAGES.includes(type) ? "image" : type in LAYERS || type === "geometry_msgs/Pose" ? "map" : "";
  const toggle = (path) => setFields((before) => toggled(before, path));
  const shared = { connection, topic, onOld: setOld };
  return html`<${Panel}
    title="Live"
    wide
    aside=${html`${on && old && html`<${Mark} state="STALE" word="nothing comes" />`}<${Choice}
        label="Live messages"
        value=${on}
        onChoose=${(next) => {
          setOn(next);
          setOld(false);
        }}
        options=${SWITCH}
      />`}
  >
    ${!on
      ? html`<p class="empty">
          Nothing is subscribed to. Switched on, <code>rmpa web</code> subscribes to it as a node of this module, once
          for all its clients.
        </p>`
      : html`<div class=${view || fields.length ? "live two" : "live"}>
          <div class="views">
            ${view === "image" && html`<${Image} ...${shared} type=${type} state=${state} />`}${view === "map" &&
            html`<${TopicMap} connection=${connection} state=${state} topic=${topic} type=${type} />`}
            ${fields.length > 0 && html`<${Fields} key=${fields.join()} ...${shared} fields=${fields} />`}
          </div>
          <${Value} ...${shared} chosen=${fields} onChoose=${toggle} />
        </div>`}<//
  >`;
}

export function Value({ connection, topic, chosen, onChoose, onOld }) {
  const [message, set] = useState(null);
  const watched = useWatch(connection, { topic, how: "value", rate: 5 }, set);
  return html`<${Fresh} watched=${watched} onOld=${onOld}>
    <${Failure} failure=${watched.failure} />${message
      ? html`<p class="muted">
            ${clock(message.stamp)} · ${bytes(message.size)} · ${message.type}. Numbers can be chosen to be plotted.
          </p>
          <${MessageTree} value=${message.value} chosen=${chosen} onChoose=${onChoose} />`
      : !watched.failure && html`<p class="empty">Waiting for a message …</p>`}<//
  >`;
}

export function Fields({ connection, topic, fields, onOld }) {
  const data = useRef([[], ...fields.map(() => [])]);
  const [version, grow] = useState(0);
  const watched = useWatch(connection, { topic, how: "plot", fields, rate: 10 }, (message) => {
    append(data.current, message.columns);
    grow((n) => n + 1);
  });
  return html`<div class="wide">
    <${Fresh} ...${{ watched, onOld }}
      ><${Failure} failure=${watched.failure} /><${Plot}
        labels=${fields}
        data=${data.current}
        version=${version}
        format=${figure}
        label="Fields"
    /><//>
  </div>`;
}

const PLACE_STEP = 64; // device pixels: a place that changes by less is not told

// The device's pixels that an element has for its width; 0 before it is drawn.
function usePlace(element) {
  const [place, set] = useState(0);
  useLayoutEffect(() => {
    const measure = () =>
      set(Math.ceil((element.current.clientWidth * devicePixelRatio) / PLACE_STEP) * PLACE_STEP || PLACE_STEP);
    measure();
    const observer = new ResizeObserver(measure);
    observer.observe(element.current);
    return () => observer.disconnect();
  }, []);
  return place;
}

// What is drawn a second, by the last pictures.
function pace(moments) {
  moments.push(performance.now());
  if (moments.length > 20) moments.shift();
  return ((moments.length - 1) * 1000) / (moments[moments.length - 1] - moments[0]);
}

export function Image({ connection, topic, type, state, onOld }) {
  const canvas = useRef(),
    place = useRef(),
    drawn = useRef([]);
  const [about, set] = useState(null);
  const [compressed, setCompressed] = useState(false);
  const busy = useRef(false);
  const show = async (message) => {
    if (busy.current || !canvas.current) return; // a picture that comes while one is decoded is left out
    busy.current = true;
    try {
      const size = await paint(canvas.current, message);
      const whole = message.whole[0] ? message.whole : size;
      set({ size, whole, format: message.format, stamp: message.stamp, rate: pace(drawn.current) });
    } catch {
      set({ broken: true });
    } finally {
      busy.current = false;
    }
  };
  const other = `${topic}/compressed`;
  const offered = section(section(state, "topics"), other).type === "sensor_msgs/CompressedImage";
  const shown = compressed && offered ? other : topic;
  const width = usePlace(place);
  const watched = useWatch(connection, width ? { topic: shown, how: "image", rate: 10, width } : null, show);
  const old = useOld(watched.came, watched.beat?.after);
  const from = (section(section(state, "topics"), shown).from || []).filter(
    (each) => each !== section(state, "agent").name,
  );
  const crossing =
    type === "sensor_msgs/Image" && shown === topic && from.length > 0 && watched.beat && !old
      ? `${bandwidth(watched.beat.bandwidth)} cross the mesh from ${from.join(", ")} for it. `
      : "";
  return html`<figure class="wide" ref=${place}>
    <${Fresh} ...${{ watched, onOld }}
      ><${Failure} failure=${watched.failure} /><canvas
        class="view"
        ref=${canvas}
        width="320"
        height="240"
        role="img"
        aria-label=${`Pictures of ${shown}`}
      ></canvas>
      <figcaption class="muted">${caption(about)}</figcaption><//
    >${(crossing || offered) &&
    html`<p class="row">
      ${crossing}${offered &&
      html`<button type="button" aria-pressed=${String(shown === other)} onClick=${() => setCompressed(!compressed)}>
        ${shown === other ? `Show ${topic}` : `Show ${other} instead`}
      </button>`}
    </p>`}
  </figure>`;
}

function caption(about) {
  if (!about) return "Waiting for a picture …";
  if (about.broken) return "The picture cannot be decoded.";
  const { size, whole, format, stamp, rate } = about;
  const smaller = size[0] < whole[0] ? `drawn as ${size.join(" × ")}, ` : "";
  return `${whole.join(" × ")} · ${format} · ${smaller}${hertz(rate)} drawn · ${clock(stamp)}`;
}

// Draws a picture, and returns its size.
async function paint(view, { format, bytes: raw, width, height }) {
  if (format === "jpeg" || format === "png") {
    const picture = await createImageBitmap(new Blob([raw], { type: `image/${format}` }));
    view.width = picture.width;
    view.height = picture.height;
    view.getContext("2d").drawImage(picture, 0, 0);
    picture.close();
  } else {
    view.width = width;
    view.height = height;
    view.getContext("2d").putImageData(pixels(width, height, format, raw), 0, 0);
  }
  return [view.width, view.height];
}

function pixels(width, height, format, raw) {
  const made = new ImageData(width, height),
    out = new Uint32Array(made.data.buffer); // alpha, blue, green, red: browsers run on little-endian machines
  const step = format === "mono8" ? 1 : 3;
  const [red, green, blue] = { rgb8: [0, 1, 2], bgr8: [2, 1, 0] }[format] || [0, 0, 0];
  for (let to = 0, at = 0; to < out.length; to += 1, at += step)
    out[to] = 0xff000000 | (raw[at + blue] << 16) | (raw[at + green] << 8) | raw[at + red];
  return made;
}
