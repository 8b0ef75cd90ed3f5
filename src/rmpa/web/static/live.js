// Live messages of one topic: the newest value, plots of any number in it, images, laser scans, the pose of a robot.

import { html, useEffect, useRef, useState } from "./markup.js";
import { bytes, clock } from "./format.js";
import { Choice, Failure, Panel } from "./parts.js";
import { Plot, append } from "./plot.js";
import { MessageTree } from "./tree.js";

export const IMAGES = ["sensor_msgs/Image", "sensor_msgs/CompressedImage"];
const POSES = {
  "nav_msgs/Odometry": "pose.pose",
  "geometry_msgs/PoseStamped": "pose",
  "geometry_msgs/PoseWithCovarianceStamped": "pose.pose",
  "geometry_msgs/Pose": "",
};
const MOST_LINES = 8;
const JUMP = 0.5; // metres between two poses, beyond which the trail begins anew

export function Live({ connection, topic, type }) {
  const [on, setOn] = useState(false);
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
  return html`<${Panel}
    title="Live"
    wide
    aside=${html`<${Choice}
      label="Live messages"
      value=${on}
      onChoose=${setOn}
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
      : html`<div class=${view || fields.length ? "live two" : "live"}>
          <div class="views">
            ${view === "image" && html`<${Image} connection=${connection} topic=${topic} />`}${view === "scan" &&
            html`<${Scan} connection=${connection} topic=${topic} />`}
            ${view === "pose" && html`<${Pose} connection=${connection} topic=${topic} path=${POSES[type]} />`}
            ${fields.length > 0 &&
            html`<${Fields} key=${fields.join()} connection=${connection} topic=${topic} fields=${fields} />`}
          </div>
          <${Value} connection=${connection} topic=${topic} chosen=${fields} onChoose=${toggle} />
        </div>`}<//
  >`;
}

function useWatch(connection, wanted, take) {
  const [failure, setFailure] = useState(null);
  const sink = useRef(take);
  sink.current = take;
  useEffect(() => {
    setFailure(null);
    return connection.watch(wanted, (message) =>
      message.op === "failed" ? setFailure(message) : sink.current(message),
    );
  }, [JSON.stringify(wanted)]);
  return failure;
}

export function Value({ connection, topic, chosen, onChoose }) {
  const [message, set] = useState(null);
  const failure = useWatch(connection, { topic, how: "value", rate: 5 }, set);
  return html`<div>
    <${Failure} failure=${failure} />${message
      ? html`<p class="muted">
            ${clock(message.stamp)} · ${bytes(message.size)} · ${message.type}. Numbers can be chosen to be plotted.
          </p>
          <${MessageTree} value=${message.value} chosen=${chosen} onChoose=${onChoose} />`
      : !failure && html`<p class="empty">Waiting for a message …</p>`}
  </div>`;
}

export function Fields({ connection, topic, fields }) {
  const data = useRef([[], ...fields.map(() => [])]);
  const [version, grow] = useState(0);
  const failure = useWatch(connection, { topic, how: "plot", fields, rate: 10 }, (message) => {
    append(data.current, message.columns);
    grow((n) => n + 1);
  });
  const number = (value) => (value === null || value === undefined ? "–" : Number(value.toPrecision(5)).toString());
  return html`<div class="wide">
    <${Failure} failure=${failure} /><${Plot}
      labels=${fields}
      data=${data.current}
      version=${version}
      format=${number}
      label="Fields"
    />
  </div>`;
}

function Canvas({ draw, label, version }) {
  const canvas = useRef();
  useEffect(() => {
    if (canvas.current) draw(canvas.current);
  }, [version]);
  return html`<canvas class="view" ref=${canvas} width="960" height="600" role="img" aria-label=${label}></canvas>`;
}

export function Image({ connection, topic }) {
  const canvas = useRef();
  const [about, set] = useState("");
  const busy = useRef(false);
  const show = async (message) => {
    if (busy.current || !canvas.current) return; // a picture that comes while one is decoded is left out
    busy.current = true;
    try {
      const view = canvas.current;
      if (message.format === "jpeg" || message.format === "png") {
        const picture = await createImageBitmap(new Blob([message.bytes], { type: `image/${message.format}` }));
        view.width = picture.width;
        view.height = picture.height;
        view.getContext("2d").drawImage(picture, 0, 0);
        picture.close();
      } else view.getContext("2d").putImageData(pixels(view, message), 0, 0);
      set(`${view.width} × ${view.height} · ${message.format} · ${clock(message.stamp)}`);
    } catch {
      set("The picture cannot be decoded.");
    } finally {
      busy.current = false;
    }
  };
  const failure = useWatch(connection, { topic, how: "image", rate: 10 }, show);
  return html`<figure class="wide">
    <${Failure} failure=${failure} /><canvas
      class="view"
      ref=${canvas}
      width="320"
      height="240"
      role="img"
      aria-label=${`Pictures of ${topic}`}
    ></canvas>
    <figcaption class="muted">${about || "Waiting for a picture …"}</figcaption>
  </figure>`;
}

function pixels(view, { width, height, format, bytes: raw }) {
  view.width = width;
  view.height = height;
  const made = new ImageData(width, height),
    out = made.data,
    channels = format === "rgb8" ? 3 : 1;
  for (let from = 0, to = 0; to < out.length; from += channels, to += 4) {
    out[to] = raw[from];
    out[to + 1] = raw[from + (channels > 1 ? 1 : 0)];
    out[to + 2] = raw[from + (channels > 1 ? 2 : 0)];
    out[to + 3] = 255;
  }
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

function Scan({ connection, topic }) {
  const [message, set] = useState(null);
  const failure = useWatch(connection, { topic, how: "scan", rate: 5 }, set);
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
  return html`<div>
    <${Failure} failure=${failure} /><${Canvas}
      draw=${draw}
      version=${message}
      label=${`Laser scan: ${seen.length} of ${scan?.ranges.length || 0} ranges, the nearest ${nearest} m`}
    />
  </div>`;
}

const FAR = 1e7; // metres: beyond it no grid can be drawn, and no robot stands

function Pose({ connection, topic, path }) {
  const trail = useRef([]);
  const [message, set] = useState(null);
  const failure = useWatch(connection, { topic, how: "value", rate: 10 }, (next) => {
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
    <${Failure} failure=${failure} /><${Canvas} draw=${draw} version=${message} label=${`Pose: ${said}`} />
    <figcaption class="muted mono">${said}</figcaption>
  </figure>`;
}
