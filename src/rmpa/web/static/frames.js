// The frames of tf as a page knows them: the sender of each transform, what one frame is in another, and what is wrong.
// A pose is [x, y, z, qx, qy, qz, qw], in metres: that of the child in its parent.

const KEPT = 30; // transforms of each frame, of the last seconds, for a stamp between two of them
const MEASURED = 3; // seconds over which a rate is measured
const DEEPEST = 200; // frames from one to its root
const LATE = 2; // seconds; a transform that moves is sent more often
export const SILENT = 10; // seconds after which a sender does not count any more beside another one

export function turned([x, y, z, w], [px, py, pz]) {
  const tx = 2 * (y * pz - z * py),
    ty = 2 * (z * px - x * pz),
    tz = 2 * (x * py - y * px);
  return [px + w * tx + y * tz - z * ty, py + w * ty + z * tx - x * tz, pz + w * tz + x * ty - y * tx];
}

const product = ([ax, ay, az, aw], [bx, by, bz, bw]) => [
  aw * bx + ax * bw + ay * bz - az * by,
  aw * by - ax * bz + ay * bw + az * bx,
  aw * bz + ax * by - ay * bx + az * bw,
  aw * bw - ax * bx - ay * by - az * bz,
];

// First `b`, then `a`: of c in b and b in a, c in a.
export function composed(a, b) {
  const turn = a.slice(3);
  const at = turned(turn, b);
  return [a[0] + at[0], a[1] + at[1], a[2] + at[2], ...product(turn, b.slice(3))];
}

export function inverted(pose) {
  const turn = [-pose[3], -pose[4], -pose[5], pose[6]];
  return [...turned(turn, pose).map((each) => -each), ...turn];
}

export const SAME = [0, 0, 0, 0, 0, 0, 1];

function unit(pose) {
  const size = Math.hypot(pose[3], pose[4], pose[5], pose[6]);
  return [...pose.slice(0, 3), ...pose.slice(3).map((each) => each / size)];
}

function between(a, b, share) {
  const sign = a[3] * b[3] + a[4] * b[4] + a[5] * b[5] + a[6] * b[6] < 0 ? -1 : 1;
  return unit(a.map((each, at) => each + ((at < 3 ? 1 : sign) * b[at] - each) * share));
}

// Roll, pitch and yaw in radians (fixed axes x, y, z).
export function angles([, , , x, y, z, w]) {
  const side = Math.max(-1, Math.min(1, 2 * (w * y - z * x)));
  return [
    Math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
    Math.asin(side),
    Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
  ];
}

export const isLate = ({ fixed, heard }, now) => !fixed && now - heard > LATE;

export class Frames {
  constructor() {
    this.edges = new Map(); // of each child: by sender
    this.leftOut = 0;
  }

  // Rows as the server sends them; `heard` is the page's time (seconds).
  take({ frames, left_out: leftOut }, heard) {
    this.leftOut = leftOut;
    for (const [child, parent, source, fixed, stamp, at, count, pose] of frames) {
      if (!this.edges.has(child)) this.edges.set(child, new Map());
      const senders = this.edges.get(child);
      const before = senders.get(source);
      const edge = before?.parent === parent && stamp >= before.stamp ? before : { poses: [], counts: [] };
      Object.assign(edge, { child, parent, source, fixed, stamp, at, heard, pose: pose && unit(pose) });
      if (pose && !fixed) edge.poses = [...edge.poses.slice(1 - KEPT), [stamp, edge.pose]];
      if (edge.counts.at(-1)?.[1] > count) edge.counts = []; // the server counts anew
      edge.counts = [...edge.counts.filter(([when]) => at - when < MEASURED), [at, count]];
      senders.set(source, edge);
    }
  }

  // Transforms a second, of a sender that is heard.
  static rate({ counts, fixed, heard }, now) {
    const [first, last] = [counts[0], counts.at(-1)];
    if (fixed || now - heard > MEASURED || last[0] - first[0] < 0.5) return undefined;
    return (last[1] - first[1]) / (last[0] - first[0]);
  }

  static module = (source) => (source.includes(":") ? source.slice(0, source.indexOf(":")) : "");

  // The transform of a frame to its parent that holds: of the module that is meant, else the newest.
  edge(child, module) {
    const all = [...(this.edges.get(child)?.values() ?? [])].sort((a, b) => b.heard - a.heard);
    return all.find((each) => Frames.module(each.source) === module) ?? all[0];
  }

  // The frames above one, itself included.
  above(frame, module) {
    const names = [frame],
      edges = [];
    for (let edge = this.edge(frame, module); edge; edge = this.edge(edge.parent, module)) {
      edges.push(edge);
      if (names.includes(edge.parent) || edges.length > DEEPEST) return { names, edges, loop: true };
      names.push(edge.parent);
    }
    return { names, edges, loop: false };
  }

  // At a stamp between two transforms: between them; before or after all: the nearest one.
  static at(edge, stamp) {
    const { poses, pose } = edge;
    const next = stamp ? poses.findIndex(([when]) => when >= stamp) : -1;
    if (next < 0) return pose;
    if (next === 0) return poses[0][1];
    const [[from, a], [to, b]] = [poses[next - 1], poses[next]];
    return between(a, b, (stamp - from) / (to - from || 1));
  }

  // What `frame` is in `target` at a stamp: { pose, edges }, or { problem }.
  lookup(target, frame, stamp = 0, module = "") {
    const missing = `no transform from ${frame || "a frame without a name"} to ${target}`;
    if (frame === target) return { pose: SAME, edges: [] };
    const [one, other] = [this.above(frame, module), this.above(target, module)];
    if (one.loop || other.loop) return { problem: `${missing}: the frames above are a loop` };
    const common = one.names.find((name) => other.names.includes(name));
    if (common === undefined) {
      const unknown = [frame, target].filter((name) => !this.knows(name));
      const why = unknown.length ? `no node sends ${unknown.join(" or ")}` : "they are in two trees";
      return { problem: `${missing}: ${why}` };
    }
    const up = one.edges.slice(0, one.names.indexOf(common)),
      down = other.edges.slice(0, other.names.indexOf(common));
    const bad = [...up, ...down].find((edge) => !edge.pose);
    if (bad) return { problem: `${missing}: that of ${bad.child} has NaN or no rotation` };
    const chain = (edges) => edges.reduce((made, edge) => composed(Frames.at(edge, stamp), made), SAME);
    return { pose: composed(inverted(chain(down)), chain(up)), edges: [...up, ...down] };
  }

  get names() {
    const all = new Set(this.edges.keys());
    for (const senders of this.edges.values()) for (const edge of senders.values()) all.add(edge.parent);
    return [...all].sort();
  }

  knows = (name) =>
    this.edges.has(name) || [...this.edges.values()].some((one) => [...one.values()].some((e) => e.parent === name));

  get roots() {
    return this.names.filter((name) => !this.edges.has(name));
  }

  // By parent, for a tree that is read from its roots; frames of a loop are below no root.
  get children() {
    const found = new Map();
    for (const child of [...this.edges.keys()].sort()) {
      const { parent } = this.edge(child);
      found.set(parent, [...(found.get(parent) ?? []), child]);
    }
    return found;
  }

  // What is wrong, each as { frame, level, text }; `isThere` says whether a node is in the graph.
  problems(now, isThere = () => true) {
    const found = [];
    const say = (frame, text, level = "WARN") => found.push({ frame, text, level });
    for (const [child, senders] of this.edges) {
      const all = [...senders.values()].filter((edge) => isThere(edge.source));
      const heard = all.filter((edge) => edge.fixed || now - edge.heard < SILENT);
      const parents = [...new Set(heard.map((edge) => edge.parent))];
      const by = heard.map((edge) => edge.source).join(" and ");
      if (parents.length > 1)
        say(child, `has ${parents.length} parents: ${parents.join(" and ")}, sent by ${by}`, "ERROR");
      else if (heard.length > 1) say(child, `is sent by ${heard.length} nodes: ${by}`);
      for (const edge of senders.values())
        if (!edge.pose) say(child, `has NaN or no rotation, sent by ${edge.source}`, "ERROR");
      const up = this.above(child);
      if (up.loop && up.edges.at(-1).parent === child && up.names.every((name) => name >= child))
        say(child, `is in a loop: ${[...up.names, child].join(" → ")}`, "ERROR");
    }
    const roots = this.roots;
    if (roots.length > 1)
      say(roots[0], `and ${roots.slice(1).join(", ")}: ${roots.length} trees without a transform between them`);
    if (this.leftOut) say("", `${this.leftOut} transforms of further frames are left out`);
    return found.sort((a, b) => (a.level === b.level ? 0 : a.level === "ERROR" ? -1 : 1));
  }
}
