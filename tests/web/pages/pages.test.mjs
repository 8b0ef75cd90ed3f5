// What the pages compute: the layout of the ring, figures as text, patches, and the search.
import assert from "node:assert/strict";
import test from "node:test";

import { Frames, angles, composed, inverted } from "./static/frames.js";
import { bandwidth, bytes, duration, hertz, plain, seconds, sentence } from "./static/format.js";
import { curve, layout } from "./static/layout.js";
import { SIZE, arrange, chord, emptyRing, geometry, outside, place } from "./static/ring.js";
import { adopt, applyPatch } from "./static/state.js";
import { askedFor, bound, earlier, fresh, record, spells, windows } from "./static/timeline.js";
import { meaning } from "./static/pages/description.js";
import { primitive } from "./static/typed.js";

const THIN = "\u2009";
const far = (a, b) => Math.hypot(a.x - b.x, a.y - b.y);

test("a module keeps its place when others come and go, and this module is at the top", () => {
  const ring = emptyRing();
  const before = arrange(ring, "pc", ["pc", "base", "arm"]);
  assert.equal(before.places.pc, 0);
  assert.equal(new Set(Object.values(before.places)).size, 3);
  assert.deepEqual(arrange(ring, "pc", ["base", "arm", "pc"]), before);
  const more = arrange(ring, "pc", ["arm", "pc", "camera"]);
  assert.equal(more.places.arm, before.places.arm);
  assert.equal(more.places.camera, before.places.base);
});

test("a full ring gets more slots, and its order stays", () => {
  const ring = emptyRing();
  const names = Array.from({ length: 300 }, (_, at) => `m${String(at).padStart(3, "0")}`);
  let order = [];
  for (const most of [1, 4, 5, 9, 30, 256, 300]) {
    const { slots, places } = arrange(ring, names[0], names.slice(0, most));
    assert.equal(new Set(Object.values(places)).size, most);
    assert.ok(Math.max(...Object.values(places)) < slots);
    const present = Object.keys(places).sort((a, b) => places[a] - places[b]);
    assert.deepEqual(
      present.filter((name) => order.includes(name)),
      order,
    );
    order = present;
  }
});

test("another module's page begins a ring of its own", () => {
  const ring = emptyRing();
  arrange(ring, "pc", ["pc", "base"]);
  assert.deepEqual(arrange(ring, "base", ["pc", "base"]).places.base, 0);
});

for (const slots of [4, 8, 16, 32, 256])
  for (const compact of [false, true])
    test(`${slots} modules stand inside the picture and apart${compact ? ", on a phone" : ""}`, () => {
      const geo = geometry(slots, compact);
      const places = Array.from({ length: slots }, (_, slot) => place(slot, geo));
      for (const at of places) {
        assert.ok(at.x >= geo.node && at.x <= SIZE - geo.node && at.y >= geo.node && at.y <= SIZE - geo.node);
        if (geo.small) assert.ok(["start", "middle", "end"].includes(outside(at, geo).anchor));
      }
      if (slots <= 16) assert.ok(far(places[0], places[1]) > 2 * geo.node, "two neighbours overlap");
    });

test("a chord goes from edge to edge, and both directions are apart", () => {
  const geo = geometry(4, false);
  const [a, b] = [place(0, geo), place(1, geo)];
  const there = chord(a, b, geo.node, 9);
  assert.match(there.d, /^M[\d.]+ [\d.]+Q[\d.]+ [\d.]+ [\d.]+ [\d.]+$/);
  assert.ok(Math.abs(far(there.at(0), a) - Math.hypot(geo.node + 10, 9)) < 9);
  assert.ok(far(there.at(0.5), chord(b, a, geo.node, 9).at(0.5)) > 10);
  assert.doesNotMatch(chord(a, a, geo.node, 0).d, /NaN/);
});

test("figures have three digits and a unit", () => {
  for (const [said, text] of [
    [bytes(0), "0 B"],
    [bytes(999), "999 B"],
    [bytes(1234567), "1.23 MB"],
    [bandwidth(36900), "36.9 kB/s"],
    [bandwidth(undefined), "–"],
    [hertz(49.96), "50 Hz"],
    [hertz(9.95), "9.9 Hz"],
    [hertz(0.123), "0.12 Hz"],
    [hertz(1234.5), "1235 Hz"],
    [seconds(0), "0 s"],
    [seconds(0.00035), "350 µs"],
    [seconds(0.0123), "12.3 ms"],
    [seconds(2), "2.00 s"],
    [seconds(3600), "1 h 00 min"],
    [seconds(NaN), "–"],
    [duration(59.4), "59 s"],
    [duration(61), "1 min 01 s"],
    [duration(90000), "1 d 1 h"],
  ])
    assert.equal(said, text.replaceAll(/(?<=\d) /g, THIN).replaceAll(/(?<=min|h|d) /g, " "));
});

test("what is not seen in a text is shown by its code", () => {
  assert.equal(plain("a\u202eb\u0000"), "a\\u202eb\\u0000");
  assert.equal(plain("naïve – ok"), "naïve – ok");
  assert.equal(sentence("no agent answers"), "No agent answers.");
  assert.equal(sentence("rmpa up starts one"), "rmpa up starts one.");
  assert.equal(sentence(""), "");
});

test("a patch changes what it names alone, and removes with null (RFC 7396)", () => {
  const state = adopt({ topics: { "/a": { rate: 1 }, "/b": { rate: 2 } }, notes: ["x"] });
  const next = applyPatch(state, { topics: { "/a": { rate: 5 }, "/b": null }, notes: [] });
  assert.equal(JSON.stringify(next), '{"topics":{"/a":{"rate":5}},"notes":[]}');
  assert.equal(applyPatch(state, { notes: ["y"] }).topics, state.topics, "what is not touched is the same object");
  assert.equal(applyPatch(state, { ["__proto__"]: { polluted: 1 } }).polluted, undefined);
  assert.equal(adopt(JSON.parse('{"__proto__": {"toString": 1}}')).toString, undefined);
});

// A robot of some nodes and topics in lanes, always the same one, with cycles.
function robot(nodes, topics) {
  let seed = 7;
  const next = (most) => ((seed = (seed * 1103515245 + 12345) % 2147483648), seed % most);
  const lanes = ["pc", "base", "arm", "camera"];
  const vertices = [],
    edges = [];
  for (let at = 0; at < nodes; at++) vertices.push({ id: `/n${at}`, lane: lanes[at % 4], w: 120, h: 36 });
  for (let at = 0; at < topics; at++) {
    const from = next(nodes);
    vertices.push({ id: `topic /t${at}`, lane: lanes[from % 4], w: 140, h: 27 });
    edges.push({ from: `/n${from}`, to: `topic /t${at}` });
    for (let to = next(3); to > 0; to--) edges.push({ from: `topic /t${at}`, to: `/n${next(nodes)}` });
  }
  return { vertices, edges, lanes };
}

test("a graph of 50 nodes and 100 topics is laid out without boxes over each other, each within its lane", () => {
  const { vertices, edges, lanes } = robot(50, 100);
  const drawn = layout(vertices, edges, lanes);
  for (const one of vertices) {
    const { x, y } = drawn.at.get(one.id);
    const lane = drawn.lanes.find((each) => each.name === one.lane);
    assert.ok(y - one.h / 2 >= lane.y && y + one.h / 2 <= lane.y + lane.h, one.id);
    assert.ok(x - one.w / 2 >= 0 && x + one.w / 2 <= drawn.width, one.id);
    for (const other of vertices.slice(0, vertices.indexOf(one))) {
      const there = drawn.at.get(other.id);
      const apart = Math.abs(there.x - x) * 2 >= one.w + other.w || Math.abs(there.y - y) * 2 >= one.h + other.h;
      assert.ok(apart, `${one.id} ${other.id}`);
    }
  }
  assert.equal(drawn.paths.length, edges.length);
  assert.ok(drawn.paths.every(({ points }) => /^M[\d. ]+(C[-\d. ]+)+$/.test(curve(points))));
});

test("a layout stays as it is, and few boxes move when a node comes", () => {
  const { vertices, edges, lanes } = robot(20, 40);
  let drawn = layout(vertices, edges, lanes);
  for (let turn = 0; turn < 3; turn++) drawn = layout(vertices, edges, lanes, drawn);
  const moved = (now) =>
    vertices.filter(({ id }) => far(now.at.get(id), drawn.at.get(id)) > 60).length / vertices.length;
  assert.equal(moved(layout(vertices, edges, lanes, drawn)), 0);
  const more = [...vertices, { id: "/new", lane: "arm", w: 120, h: 36 }];
  const link = [...edges, { from: "topic /t0", to: "/new" }];
  assert.ok(moved(layout(more, link, lanes, drawn)) < 0.2);
});

test("edges that need not cross do not", () => {
  const names = [..."abcdef"];
  const box = (id) => ({ id, lane: "pc", w: 40, h: 20 });
  const ends = Object.fromEntries(names.map((each, at) => [each, `z${names.length - at}`])); // each crosses each
  const edges = names.map((from) => ({ from, to: ends[from] }));
  const { at } = layout([...names, ...Object.values(ends)].map(box), edges, ["pc"]);
  const height = (id) => at.get(id).y;
  const sorted = [...names].sort((a, b) => height(a) - height(b));
  assert.deepEqual(
    Object.values(ends).sort((a, b) => height(a) - height(b)),
    sorted.map((each) => ends[each]),
  );
});

test("a chain, a cycle and a loop have their columns", () => {
  const box = (id) => ({ id, lane: "pc", w: 40, h: 20 });
  const link = (text) => text.split(" ").map((each) => ({ from: each[0], to: each[1] }));
  const columns = (names, edges) => {
    const { at } = layout([...names].map(box), link(edges), ["pc"]);
    const order = [...new Set([...at.values()].map(({ x }) => x))].sort((a, b) => a - b);
    return [...names].map((name) => order.indexOf(at.get(name).x)).join("");
  };
  assert.equal(columns("abcd", "ab bc ad dc"), "0121");
  assert.equal(columns("abc", "ab bc ca"), "012");
  assert.equal(columns("ab", "aa ab"), "01");
  assert.equal(columns("abcd", "ab bc dc"), "0121"); // what only sends stands before what it sends to
});

const near = (a, b) => a.forEach((each, at) => assert.ok(Math.abs(each - b[at]) < 1e-9, `${a} is not ${b}`));
const QUARTER = [0, 0, Math.SQRT1_2, Math.SQRT1_2]; // to the left
const NONE = [0, 0, 0, 1];
let received = 0;
const row = (child, parent, pose, { by = "/a", stamp = 1, fixed = false } = {}) => [
  child,
  parent,
  by,
  fixed,
  stamp,
  stamp,
  (received += 1),
  pose,
];
function framesOf(...rows) {
  const made = new Frames();
  for (const each of rows) made.take({ frames: [each], left_out: 0 }, each[4]);
  return made;
}

test("what one frame is in another goes up one branch of the tree and down another", () => {
  const frames = framesOf(
    row("odom", "map", [1, 2, 0, ...QUARTER]),
    row("base", "odom", [3, 0, 0, ...NONE]),
    row("laser", "base", [0, 1, 0.5, ...NONE], { fixed: true }),
    row("other", "map", [5, 0, 0, ...NONE]),
  );
  near(frames.lookup("map", "laser").pose, [0, 5, 0.5, ...QUARTER]);
  near(frames.lookup("other", "laser").pose, [-5, 5, 0.5, ...QUARTER]);
  near(composed(frames.lookup("laser", "other").pose, frames.lookup("other", "laser").pose), [0, 0, 0, ...NONE]);
  near(angles(inverted([0, 0, 0, ...QUARTER])), [0, 0, -Math.PI / 2]);
  assert.deepEqual(frames.roots, ["map"]);
});

test("a transform between two stamps is between them, and outside of all the nearest one", () => {
  const at = (stamp, x, turn) => row("base", "odom", [x, 0, 0, ...turn], { stamp });
  const frames = framesOf(at(10, 0, NONE), at(11, 4, QUARTER));
  const pose = frames.lookup("odom", "base", 10.25).pose;
  near(pose.slice(0, 3), [1, 0, 0]);
  assert.ok(Math.abs(angles(pose)[2] - Math.PI / 8) < 0.02);
  const nearest = { 9: 0, 99: 4, 0: 4 };
  for (const [stamp, x] of Object.entries(nearest))
    near(frames.lookup("odom", "base", Number(stamp)).pose.slice(0, 1), [x]);
});

test("what cannot be looked up says why, also in a loop", () => {
  const frames = framesOf(
    row("a", "map", [0, 0, 0, ...NONE]),
    row("b", "c", [0, 0, 0, ...NONE]),
    row("c", "b", [0, 0, 0, ...NONE]),
    row("d", "map", null),
    row("f", "g", [0, 0, 0, ...NONE]),
  );
  for (const [frame, said] of [
    ["x", "no node sends x"],
    ["b", "a loop"],
    ["d", "NaN"],
    ["f", "two trees"],
    ["", "a frame without a name"],
  ])
    assert.ok(frames.lookup("map", frame).problem.includes(said), frame);
  assert.deepEqual(
    frames.problems(1).map(({ frame }) => frame),
    ["b", "d", "g"],
  );
});

test("two parents and two senders are pointed out, and a layer has the frames of its own module", () => {
  const frames = framesOf(
    row("base", "odom", [1, 0, 0, ...NONE], { by: "one:/a", stamp: 1 }),
    row("base", "odom", [2, 0, 0, ...NONE], { by: "two:/a", stamp: 2 }),
  );
  near(frames.lookup("odom", "base", 0, "one").pose, [1, 0, 0, ...NONE]);
  near(frames.lookup("odom", "base", 0, "").pose, [2, 0, 0, ...NONE]);
  assert.match(frames.problems(2)[0].text, /is sent by 2 nodes: one:\/a and two:\/a/);
  assert.deepEqual(
    frames.problems(2, (node) => node !== "one:/a"),
    [],
  );
  assert.deepEqual(frames.problems(99), []); // silent by then
  frames.take({ frames: [row("base", "map", [0, 0, 0, ...NONE], { by: "two:/a", stamp: 3 })], left_out: 0 }, 3);
  assert.match(frames.problems(3)[0].text, /has 2 parents: odom and map/);
});

test("a value of a message is of its type, or says what would be", () => {
  for (const [type, typed, value] of [
    ["int8", "-128", -128],
    ["uint64", "18446744073709551615", "18446744073709551615"],
    ["int64", "-9223372036854775808", "-9223372036854775808"],
    ["float64", " -Inf ", "-inf"],
    ["float32", "NaN", "nan"],
    ["float64", "1e300", 1e300],
    ["bool", "True", true],
    ["time", "now", "now"],
    ["duration", "-1.5", { secs: -2, nsecs: 500000000 }],
    ["string", " x ", " x "],
  ])
    assert.deepEqual(primitive(type, typed), { value }, typed);
  for (const [type, typed, said] of [
    ["uint8", "256", "not within 0 … 255"],
    ["int8", "128", "not within -128 … 127"],
    ["uint64", "18446744073709551616", "not within"],
    ["int64", "1e3", "all its digits"],
    ["int32", "1.5", "whole"],
    ["int32", "nan", "not a number"],
    ["float32", "1e39", "does not fit"],
    ["float64", "1,5", "write it as 1.5"],
    ["float64", "", "Type a number"],
    ["time", "-1", "do not fit"],
    ["time", "soon", "Type now"],
    ["bool", "2", "neither true nor false"],
  ])
    assert.ok(primitive(type, typed).error.includes(said), `${type} ${typed}`);
});

test("the past of a resource is what it tells and what the page has seen, each decision once", () => {
  const past = fresh();
  const told = (history, profile) => ({ decision: { history, scores: [profile] }, profile });
  const first = { at: 100, from: "", to: "full", why: "it starts", took: 0.1 };
  const second = { at: 200, from: "full", to: "small", why: "slow", took: 0.2 };
  record(past, told([first], "full"), 150);
  record(past, told([first, second], "small"), 201);
  record(past, told([second], "small"), 202); // the resource keeps ten, the page those before too
  assert.deepEqual(past.changes, [first, second]);
  assert.deepEqual([...past.scores], [[200, ["small"]]]); // those of the first were not seen when it was made
  const drawn = spells(past.changes, 50, 260).map((each) => [each.to, each.since, each.until]);
  assert.deepEqual(drawn, [
    ["full", 100, 200],
    ["small", 200, 260],
  ]);
  const failed = { at: 230, from: "small", to: "full", why: "better", took: 1, failed: "/usb_cam does not run" };
  assert.equal(spells([...past.changes, failed], 50, 260).at(-1).until, 260); // what ran before goes on
  const later = spells([second], 50, 260).map((each) => [each.to, each.since, each.until]);
  assert.deepEqual(later, [
    ["full", 50, 200],
    ["small", 200, 260],
  ]);
});

test("of an earlier release the page itself sees which profile runs", () => {
  const past = fresh();
  for (const [profile, now] of [
    ["a", 1],
    ["a", 2],
    ["b", 3],
  ])
    record(past, { decision: { scores: [] }, profile }, now);
  assert.deepEqual(
    past.changes.map((each) => [each.at, each.from, each.to]),
    [
      [1, "", "a"],
      [3, "a", "b"],
    ],
  );
});

test("a window is judged by the bound of its time", () => {
  assert.deepEqual(bound("at least 20 Hz"), { low: 20, high: Infinity });
  assert.deepEqual(bound("at most 1e-05 s"), { low: -Infinity, high: 1e-5 });
  assert.deepEqual(bound("1 m/s2 to 2 m/s2"), { low: 1, high: 2 });
  assert.deepEqual(bound("exactly 3"), { low: 3, high: 3 });
  assert.equal(bound("good or fair"), null);
  assert.equal(bound(undefined), null);
  const past = fresh();
  const window = (rate, wanted, now) => {
    const scores = [{ terms: [{ attribute: "rate", wanted }] }];
    record(past, { decision: { scores, history: [] }, health: { values: { rate: `${rate} Hz` } }, profile: "a" }, now);
  };
  window(15, "at least 20 Hz", 10);
  window(15, "at least 10 Hz", 11);
  const later = askedFor(past, { scores: [{ terms: [{ attribute: "age", wanted: "at most 1 s" }] }] }, 0);
  assert.deepEqual(
    later.map((each) => [each.attribute, each.wanted]),
    [
      ["rate", ""], // asked for no more, and still drawn
      ["age", "at most 1 s"],
    ],
  );
  earlier(past, { "": [8, 9, 9.9], rate: [25, null, 12] });
  assert.deepEqual(
    windows(past.samples, "rate", 0).map((each) => [each.at, each.value, each.short]),
    [
      [8, 25, false],
      [10, 15, true],
      [11, 15, false],
    ],
  );
});

test("the key at the cursor is explained by the table that it is in", () => {
  const help = { role: "what it is", node: "a node", "node.run": "how it starts" };
  const text = 'role = "sensing"\n\n[node.driver]\nrun = "a b"\n';
  assert.equal(meaning(text, 3, help)?.text, "what it is");
  assert.equal(meaning(text, text.indexOf("driver"), help)?.text, "a node");
  assert.equal(meaning(text, text.indexOf('a b"'), help)?.text, "how it starts");
  assert.equal(meaning(text, text.length, help), null);
});
