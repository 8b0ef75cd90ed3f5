// Live messages of one topic: the newest value, plots of any number in it, images, laser scans, the pose of a robot.

import { html, useEffect, useLayoutEffect, useRef, useState } from "./markup.js";
import { bandwidth, bytes, clock, hertz } from "./format.js";
import { Fresh, useOld, useWatch as useBeat } from "./fresh.js";
import { Choice, Failure, Mark, Panel } from "./parts.js";
import { section } from "./state.js";
import { Plot, append } from "./plot.js";

const IMAGES = ["sensor_msgs/Image", "sensor_msgs/CompressedImage"];
const POSES = {
  "nav_msgs/Odometry": "pose.pose",
  "geometry_msgs/PoseStamped": "pose",
  "geometry_msgs/PoseWithCovarianceStamped": "pose.pose",
  "geometry_msgs/Pose": "",
};
const MOST_LINES = 8;
const JUMP = 0.5; // metres between two poses, beyond which the trail begins anew

export function Live({ connection, topic, type, state }) {
  const [on, setOn] = useState(false);
  const [old, setOld] = useState(false);
  const [fields, setFields] = useState([]);
  const view = IMAGES.includes(type)
    ? "image"
    : type === "sensor_msgs/LaserScan"
      ? "scan"
      : type in POSES
        ? "pose"
        : "";
  const toggle = (path) =>
    setFields((before) =>
      before.includes(path) ? before.filter((each) => each !== path) : [...before, path].slice(-MOST_LINES),
    );
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
        options=${[
          [false, "Off"],
          [true, "On"],
        ]}
      />`}
  >
    ${!on
      ? html`<p class="empty">
          Nothing is subscribed to. Switched on, <code>rmpa web</code> subscribes to it as a node of this module, once
          for all its clients.
        </p>`
      : html`<div class="grid">
          ${view === "image" && html`<${Image} ...${shared} type=${type} state=${state} />`}${view === "scan" &&
          html`<${Scan} ...${shared} />`}
          ${view === "pose" && html`<${Pose} ...${shared} path=${POSES[type]} />`}
          ${fields.length > 0 && html`<${Fields} key=${fields.join()} ...${shared} fields=${fields} />`}
          ${view !== "image" && html`<${Value} ...${shared} chosen=${fields} onChoose=${toggle} />`}
        </div>`}<//
  >`;
}

function useWatch(connection, wanted, take) {
  const sink = useRef(take);
  sink.current = take;
  return useBeat(connection, wanted, sink);
}

function Value({ connection, topic, chosen, onChoose, onOld }) {
  const [message, set] = useState(null);
  const watched = useWatch(connection, { topic, how: "value", rate: 5 }, set);
  return html`<${Fresh} watched=${watched} onOld=${onOld}>
    <${Failure} failure=${watched.failure} />${message
      ? html`<p class="muted">
            ${clock(message.stamp)} · ${bytes(message.size)} · ${message.type}. Numbers can be chosen to be plotted.
          </p>
          <div class="tree"><${Tree} value=${message.value} path="" chosen=${chosen} onChoose=${onChoose} /></div>`
      : !watched.failure && html`<p class="empty">Waiting for a message …</p>`}<//
  >`;
}

function Tree({ value, path, chosen, onChoose }) {
  if (typeof value === "number" || typeof value === "boolean")
    return html`<button
      type="button"
      class="field"
      aria-pressed=${String(chosen.includes(path))}
      title=${`Plot ${path}`}
      onClick=${() => onChoose(path)}
    >
      ${chosen.includes(path) ? "● " : ""}${typeof value === "number" && !Number.isInteger(value)
        ? value.toPrecision(6)
        : String(value)}
    </button>`;
  if (value === null || typeof value !== "object")
    return html`<span>${typeof value === "string" ? JSON.stringify(value) : String(value)}</span>`;
  const rows = Object.entries(value);
  if (Array.isArray(value) && value.length > 12)
    return html`<details>
      <summary>${value.length} elements</summary>
      <${Rows} rows=${rows} path=${path} chosen=${chosen} onChoose=${onChoose} />
    </details>`;
  return html`<${Rows} rows=${rows} path=${path} chosen=${chosen} onChoose=${onChoose} />`;
}

const Rows = ({ rows, path, chosen, onChoose }) =>
  html`<ul>
    ${rows.map(
      ([key, inner]) =>
        html`<li key=${key}>
          <span class="key">${key}:</span>${" "}<${Tree}
            value=${inner}
            path=${path ? `${path}.${key}` : key}
            chosen=${chosen}
            onChoose=${onChoose}
          />
        </li>`,
    )}
  </ul>`;

function Fields({ connection, topic, fields, onOld }) {
  const data = useRef([[], ...fields.map(() => [])]);
  const [version, grow] = useState(0);
  const watched = useWatch(connection, { topic, how: "plot", fields, rate: 10 }, (message) => {
    append(data.current, message.columns);
    grow((n) => n + 1);
  });
  const number = (value) => (value === null || value === undefined ? "–" : Number(value.toPrecision(5)).toString());
  return html`<div class="wide">
    <${Fresh} watched=${watched} onOld=${onOld}
      ><${Failure} failure=${watched.failure} /><${Plot}
        labels=${fields}
        data=${data.current}
        version=${version}
        format=${number}
        label="Fields"
    /><//>
  </div>`;
}

function Canvas({ draw, label, version }) {
  const canvas = useRef();
  useEffect(() => {
    if (canvas.current) draw(canvas.current);
  }, [version]);
  return html`<canvas class="view" ref=${canvas} width="960" height="600" role="img" aria-label=${label}></canvas>`;
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

function Image({ connection, topic, type, state, onOld }) {
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
    <${Fresh} watched=${watched} onOld=${onOld}
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

const ink = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// Multiples of `step` within `far` of `centre`, at most a hundred.
function lines(centre, far, step) {
  const first = Math.ceil((centre - far) / step);
  return Array.from(
    { length: Math.max(0, Math.min(100, Math.floor((2 * far) / step) + 1)) || 0 },
    (_, at) => (first + at) * step,
  );
}

// A grid with the origin in the middle, x to the right and y up (REP 103); returns metres to pixels.
function field(canvas, reach, centre = { x: 0, y: 0 }) {
  const context = canvas.getContext("2d"),
    { width, height } = canvas;
  const scale = Math.min(width, height) / 2 / reach;
  const to = (x, y) => [width / 2 + (x - centre.x) * scale, height / 2 - (y - centre.y) * scale];
  const step = (10 ** Math.floor(Math.log10(reach)) * (reach / 10 ** Math.floor(Math.log10(reach)) > 5 ? 2 : 1)) / 2;
  context.clearRect(0, 0, width, height);
  context.strokeStyle = ink("--line");
  context.lineWidth = 1;
  context.beginPath();
  const wide = width / 2 / scale,
    high = height / 2 / scale;
  for (const at of lines(centre.x, wide, step)) {
    const [px] = to(at, 0);
    context.moveTo(px, 0);
    context.lineTo(px, height);
  }
  for (const at of lines(centre.y, high, step)) {
    const [, py] = to(0, at);
    context.moveTo(0, py);
    context.lineTo(width, py);
  }
  context.stroke();
  context.fillStyle = ink("--muted");
  context.font = "20px system-ui";
  context.fillText(`${Number(step.toPrecision(3))} m`, 14, height - 16);
  return { context, to, scale };
}

function robot(context, [x, y], yaw) {
  context.save();
  context.translate(x, y);
  context.rotate(-yaw);
  context.fillStyle = ink("--accent");
  context.beginPath();
  context.moveTo(20, 0);
  context.lineTo(-13, 13);
  context.lineTo(-7, 0);
  context.lineTo(-13, -13);
  context.closePath();
  context.fill();
  context.restore();
}

function Scan({ connection, topic, onOld }) {
  const [message, set] = useState(null);
  const watched = useWatch(connection, { topic, how: "scan", rate: 5 }, set);
  const scan = message?.scan;
  const seen = scan ? scan.ranges.filter((range) => range !== null) : [];
  const draw = (canvas) => {
    if (!scan) return;
    const { context, to } = field(canvas, Math.max(1, Math.min(scan.most, Math.max(...seen, 1) * 1.1)));
    context.fillStyle = ink("--good");
    scan.ranges.forEach((range, at) => {
      if (range === null) return;
      const angle = scan.start + at * scan.step;
      const [x, y] = to(range * Math.cos(angle), range * Math.sin(angle));
      context.fillRect(x - 2, y - 2, 4, 4);
    });
    robot(context, to(0, 0), 0);
  };
  const nearest = Math.min(...seen).toFixed(2);
  return html`<${Fresh} watched=${watched} onOld=${onOld}
    ><${Failure} failure=${watched.failure} /><${Canvas}
      draw=${draw}
      version=${message}
      label=${`Laser scan: ${seen.length} of ${scan?.ranges.length || 0} ranges, the nearest ${nearest} m`}
  /><//>`;
}

const FAR = 1e7; // metres: beyond it no grid can be drawn, and no robot stands

function Pose({ connection, topic, path, onOld }) {
  const trail = useRef([]);
  const [message, set] = useState(null);
  const watched = useWatch(connection, { topic, how: "value", rate: 10 }, (next) => {
    const pose = path
      .split(".")
      .filter(Boolean)
      .reduce((value, key) => value?.[key], next.value);
    if (![pose?.position?.x, pose?.position?.y].every((each) => Number.isFinite(each) && Math.abs(each) < FAR)) return;
    const { x, y, z, w } = pose.orientation;
    const last = trail.current[trail.current.length - 1];
    const jump = last && Math.hypot(pose.position.x - last.x, pose.position.y - last.y);
    if (jump > JUMP) trail.current = []; // it was put elsewhere
    trail.current.push({
      x: pose.position.x,
      y: pose.position.y,
      yaw: Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    });
    if (trail.current.length > 900) trail.current.shift();
    set(next);
  });
  const here = trail.current[trail.current.length - 1];
  const draw = (canvas) => {
    if (!here) return;
    const xs = trail.current.map((each) => each.x),
      ys = trail.current.map((each) => each.y);
    const centre = { x: (Math.min(...xs) + Math.max(...xs)) / 2, y: (Math.min(...ys) + Math.max(...ys)) / 2 };
    const { context, to } = field(
      canvas,
      Math.max(1, (Math.max(...xs) - Math.min(...xs)) * 0.6, (Math.max(...ys) - Math.min(...ys)) * 0.6),
      centre,
    );
    context.strokeStyle = ink("--accent");
    context.globalAlpha = 0.55;
    context.lineWidth = 2.5;
    context.lineJoin = "round";
    context.beginPath();
    trail.current.forEach((each, at) => context[at ? "lineTo" : "moveTo"](...to(each.x, each.y)));
    context.stroke();
    context.globalAlpha = 1;
    robot(context, to(here.x, here.y), here.yaw);
  };
  const said = here
    ? `x ${here.x.toFixed(2)} m, y ${here.y.toFixed(2)} m, yaw ${((here.yaw * 180) / Math.PI).toFixed(0)}°`
    : "waiting for a pose";
  return html`<figure>
    <${Fresh} watched=${watched} onOld=${onOld}
      ><${Failure} failure=${watched.failure} /><${Canvas} draw=${draw} version=${message} label=${`Pose: ${said}`} />
      <figcaption class="muted mono">${said}</figcaption><//
    >
  </figure>`;
}
