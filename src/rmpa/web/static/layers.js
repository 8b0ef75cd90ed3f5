// What a map from above is drawn of: the view, and the layers that messages become.

import { count } from "./format.js";
import { ink } from "./theme.js";
import { SAME, angles, composed, turned } from "./frames.js";

export const LAYERS = {
  "nav_msgs/OccupancyGrid": "grid",
  "sensor_msgs/PointCloud2": "cloud",
  "geometry_msgs/PoseArray": "poses",
  "nav_msgs/Path": "path",
  "sensor_msgs/LaserScan": "scan",
  "nav_msgs/Odometry": "pose",
  "geometry_msgs/PoseStamped": "pose",
  "geometry_msgs/PoseWithCovarianceStamped": "pose",
};
const HUES = [192, 34, 282, 110, 338, 62, 228, 158]; // of modules
const TRAIL = 600; // poses
const JUMP = 1; // metres between two poses, beyond which the trail begins anew
const NEAREST = 2000,
  FARTHEST = 0.02; // pixels a metre

export const moduleColour = (at) => `hsl(${HUES[at % HUES.length]} 70% ${ink("color-scheme") === "light" ? 32 : 64}%)`;

// x to the right and y up, in metres of the fixed frame; the size is in pixels of CSS.
export class View {
  constructor() {
    Object.assign(this, { x: 0, y: 0, scale: 40, width: 1, height: 1 });
  }
  to = (x, y) => [this.width / 2 + (x - this.x) * this.scale, this.height / 2 - (y - this.y) * this.scale];
  from = (px, py) => [this.x + (px - this.width / 2) / this.scale, this.y - (py - this.height / 2) / this.scale];
  pan(dx, dy) {
    this.x -= dx / this.scale;
    this.y += dy / this.scale;
  }
  // What is at (px, py) stays there.
  zoom(factor, px = this.width / 2, py = this.height / 2) {
    const [x, y] = this.from(px, py);
    this.scale = Math.max(FARTHEST, Math.min(NEAREST, this.scale * factor));
    this.x = x - (px - this.width / 2) / this.scale;
    this.y = y + (py - this.height / 2) / this.scale;
  }
  fit([low, bottom, high, top]) {
    this.x = (low + high) / 2;
    this.y = (bottom + top) / 2;
    const wide = Math.max(high - low, 2) * 1.1,
      tall = Math.max(top - bottom, 2) * 1.1;
    this.scale = Math.max(FARTHEST, Math.min(NEAREST, this.width / wide, this.height / tall));
  }
}

// A length of 1, 2 or 5 times a power of ten, at least `pixels` long.
export function niceLength(scale, pixels) {
  const least = pixels / scale,
    power = 10 ** Math.floor(Math.log10(least));
  return power * [1, 2, 5, 10].find((each) => each * power >= least * 0.999);
}
export const metres = (length) =>
  length >= 1000 ? `${length / 1000} km` : length < 1 ? `${Number((length * 100).toPrecision(3))} cm` : `${length} m`;

// The part of a pose that is seen from above: X = ax + cy + ez + tx, Y = bx + dy + fz + ty.
export function planar(pose) {
  const turn = pose.slice(3);
  const [[a, b], [c, d], [e, f]] = [turned(turn, [1, 0, 0]), turned(turn, [0, 1, 0]), turned(turn, [0, 0, 1])];
  return { a, b, c, d, e, f, tx: pose[0], ty: pose[1] };
}
const apply = ({ a, b, c, d, e, f, tx, ty }, x, y, z = 0) => [a * x + c * y + e * z + tx, b * x + d * y + f * z + ty];

// The messages of one node on one topic.
export class Layer {
  constructor(topic, source) {
    Object.assign(this, { topic, source, module: source.includes(":") ? source.split(":")[0] : "", trail: [] });
    this.count = 0;
  }

  // `heard` is the page's time (seconds); returns a promise where a picture is decoded.
  take(head, body, heard) {
    // `n` counts what came to the server, also what a page is not sent.
    const since = this.head && heard - this.since[0] > 2 && [heard, head.n];
    if (since) this.rate = (head.n - this.since[1]) / (heard - this.since[0]);
    if (since || !this.head || head.n < this.head.n) this.since = [heard, head.n];
    Object.assign(this, { head, heard, kind: head.kind, frame: head.frame, count: this.count + 1 });
    if (head.kind === "scan") this.points = polar(head);
    else if (head.kind === "pose") this.follow(head.pose);
    else if (head.kind === "grid") return this.picture(body);
    else this.points = new Float32Array(body.slice().buffer);
    return undefined;
  }

  follow(pose) {
    const last = this.trail.at(-1);
    if (last && Math.hypot(pose[0] - last[0], pose[1] - last[1]) > JUMP) this.trail = [];
    this.trail = [...this.trail.slice(1 - TRAIL), pose];
  }

  async picture(body) {
    const { head } = this;
    if (!body.length) return void (this.canvas = null);
    const picture = await createImageBitmap(new Blob([body], { type: "image/png" }));
    if (head === this.head) {
      this.canvas = new OffscreenCanvas(picture.width, picture.height);
      this.canvas.getContext("2d").drawImage(picture, 0, 0);
      this.tint = "";
    }
    picture.close();
  }

  // The picture of a grid in the colour of the text: its pixels have an opacity alone.
  tinted(colour) {
    if (this.canvas && this.tint !== colour) {
      const context = this.canvas.getContext("2d");
      context.globalCompositeOperation = "source-in";
      context.fillStyle = colour;
      context.fillRect(0, 0, this.canvas.width, this.canvas.height);
      this.tint = colour;
    }
    return this.canvas;
  }

  // What is to be said of it beside its picture.
  get said() {
    const { head } = this;
    if (head.cells) return `${count(head.cells[0])} × ${count(head.cells[1])}`;
    if (head.kind === "pose") {
      const [x, y] = head.pose;
      return `x ${x.toFixed(2)} m, y ${y.toFixed(2)} m, ${((angles(head.pose)[2] * 180) / Math.PI).toFixed(0)}°`;
    }
    if (head.kind !== "scan") return count(head.count);
    const seen = head.ranges.filter((each) => each !== null);
    const nearest = seen.length ? `, nearest ${Math.min(...seen).toFixed(2)} m` : "";
    return `${seen.length} of ${head.ranges.length} ranges${nearest}`;
  }

  // Corners and points in its own frame, to fit the view to.
  *extent() {
    const { head, points } = this;
    if (head.kind === "grid") {
      const place = planar(head.origin),
        [wide, high] = head.cells.map((each) => each * head.resolution);
      for (const [x, y] of [[0, 0], [wide, 0], [0, high], [wide, high]]) yield apply(place, x, y); // prettier-ignore
    } else if (head.kind === "pose") yield head.pose;
    else {
      const step = head.kind === "scan" ? 2 : 3;
      for (let at = 0; at < points.length; at += step * Math.ceil(points.length / step / 500))
        yield [points[at], points[at + 1]];
    }
  }
}

function polar({ start, step, ranges }) {
  const made = [];
  ranges.forEach((range, at) => {
    if (range !== null) made.push(range * Math.cos(start + at * step), range * Math.sin(start + at * step));
  });
  return Float32Array.from(made);
}

export function bounds(placed) {
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  for (const { layer, pose } of placed) {
    const place = planar(pose);
    for (const [x, y, z] of layer.extent()) {
      const [px, py] = apply(place, x, y, z);
      if (!Number.isFinite(px + py)) continue;
      box.splice(0, 4, Math.min(box[0], px), Math.min(box[1], py), Math.max(box[2], px), Math.max(box[3], py));
    }
  }
  return box[0] <= box[2] ? box : null;
}

function trace(context, width, points) {
  context.lineWidth = width;
  context.beginPath();
  points.forEach(([x, y], at) => (at ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.stroke();
}
const line = (context, width, from, to) => trace(context, width, [from, to]);

export function drawGround(context, view, colours) {
  const step = niceLength(view.scale, 48);
  const [low, top] = view.from(0, 0),
    [high, bottom] = view.from(view.width, view.height);
  context.strokeStyle = colours.line;
  const sharp = (at) => Math.round(at) + 0.5;
  for (let x = Math.ceil(low / step) * step; x < high; x += step) {
    const px = sharp(view.to(x, 0)[0]);
    line(context, 1, [px, 0], [px, view.height]);
  }
  for (let y = Math.ceil(bottom / step) * step; y < top; y += step) {
    const py = sharp(view.to(0, y)[1]);
    line(context, 1, [0, py], [view.width, py]);
  }
}

export function drawScale(context, view, colours) {
  const length = niceLength(view.scale, 60),
    size = length * view.scale,
    y = view.height - 16;
  context.globalAlpha = 1;
  context.strokeStyle = context.fillStyle = colours.text;
  const [left, right] = [16, 16 + size];
  trace(context, 2, [[left, y - 6], [left, y], [right, y], [right, y - 6]]); // prettier-ignore
  context.font = "13px system-ui";
  context.fillText(metres(length), 22, y - 8);
}

const DRAW = {
  grid(context, view, layer, place, colours, ratio) {
    const picture = layer.tinted(colours.text);
    if (!picture) return;
    const { head } = layer,
      cell = head.resolution * head.every;
    const at = planar(composed(layer.pose, head.origin));
    const [sx, sy] = view.to(at.tx, at.ty),
      size = view.scale * cell * ratio;
    context.save();
    context.imageSmoothingEnabled = size < ratio;
    context.setTransform(at.a * size, -at.b * size, at.c * size, -at.d * size, sx * ratio, sy * ratio);
    context.drawImage(picture, 0, 0);
    context.restore();
  },
  scan: (context, view, layer, place) => dots(context, view, layer.points, place, 2, 3),
  cloud: (context, view, layer, place) => dots(context, view, layer.points, place, 3, 2),
  path(context, view, { points }, place) {
    const poses = Array.from({ length: points.length / 3 }, (_, at) => points.subarray(3 * at, 3 * at + 3));
    way(context, view, place, poses);
  },
  pose(context, view, layer, place) {
    const { trail, head } = layer;
    context.save();
    context.globalAlpha *= 0.55;
    way(context, view, place, trail);
    context.restore();
    const at = planar(composed(layer.pose, head.pose));
    const [x, y] = view.to(at.tx, at.ty);
    if (head.spread) ellipse(context, view, place, head.spread, x, y);
    arrow(context, x, y, at.a, at.b, 14);
  },
  poses(context, view, { points }, place) {
    for (let at = 0; at + 2 < points.length; at += 3) {
      const [cos, sin] = [Math.cos(points[at + 2]), Math.sin(points[at + 2])];
      const [x, y] = view.to(...apply(place, points[at], points[at + 1]));
      arrow(context, x, y, place.a * cos + place.c * sin, place.b * cos + place.d * sin, 6);
    }
  },
};

function dots(context, view, points, { a, b, c, d, e, f, tx, ty }, step, size) {
  const { width, height } = view;
  for (let at = 0; at < points.length; at += step) {
    const x = points[at],
      y = points[at + 1],
      z = step > 2 ? points[at + 2] : 0;
    const [px, py] = view.to(a * x + c * y + e * z + tx, b * x + d * y + f * z + ty);
    if (px > -size && py > -size && px < width && py < height)
      context.fillRect(px - size / 2, py - size / 2, size, size);
  }
}

function way(context, view, place, poses) {
  context.lineJoin = "round";
  trace(
    context,
    2.5,
    poses.map(([x, y, z]) => view.to(...apply(place, x, y, z))),
  );
}

const ARROW = new Path2D("M1 0 -.65 .6 -.35 0 -.65 -.6Z");
function arrow(context, x, y, forward, left, size) {
  context.save();
  context.translate(x, y);
  context.rotate(-Math.atan2(left, forward));
  context.scale(size, size);
  context.fill(ARROW);
  context.restore();
}

// Two standard deviations.
function ellipse(context, view, place, [xx, xy, yy], x, y) {
  const middle = (xx + yy) / 2,
    half = Math.hypot((xx - yy) / 2, xy);
  const turn = Math.atan2(2 * xy, xx - yy) / 2 + Math.atan2(place.b, place.a);
  const [long, short] = [middle + half, middle - half].map((each) => 2 * Math.sqrt(Math.max(0, each)) * view.scale);
  context.lineWidth = 1.5;
  context.beginPath();
  context.ellipse(x, y, Math.min(long, 1e5), Math.min(short, 1e5), -turn, 0, 2 * Math.PI);
  context.stroke();
}

export function drawLayer(context, view, layer, pose, { colours, colour, old, ratio }) {
  layer.pose = pose ?? SAME;
  context.globalAlpha = old ? 0.4 : 1;
  context.fillStyle = context.strokeStyle = old ? colours.idle : colour;
  DRAW[layer.kind](context, view, layer, planar(layer.pose), colours, ratio);
  context.globalAlpha = 1;
}

// Each frame: its x axis long, its y axis short. Names that would cover each other are counted.
export function drawFrames(context, view, placed, colours) {
  const named = [];
  context.font = "12px system-ui";
  for (const { name, pose, colour, old } of placed) {
    const { a, b, c, d, tx, ty } = planar(pose);
    const [x, y] = view.to(tx, ty);
    context.globalAlpha = old ? 0.4 : 1;
    context.strokeStyle = old ? colours.idle : colour;
    line(context, 3, [x, y], [x + a * 22, y - b * 22]);
    line(context, 2, [x, y], [x + c * 13, y - d * 13]);
    const near = named.find((one) => Math.abs(one.x - x) < 90 && Math.abs(one.y - y) < 14);
    if (near) near.others += 1;
    else named.push({ name, x, y, others: 0 });
  }
  context.globalAlpha = 1;
  context.fillStyle = colours.muted;
  context.strokeStyle = colours.panel;
  context.lineWidth = 4;
  for (const { name, x, y, others } of named) {
    const text = others ? `${name} +${others}` : name;
    context.strokeText(text, x + 6, y + 16);
    context.fillText(text, x + 6, y + 16);
  }
}
