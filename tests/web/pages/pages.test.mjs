// What the pages compute: the layout of the ring, figures as text, patches, and the search.
import assert from "node:assert/strict";
import test from "node:test";

import { bandwidth, bytes, duration, hertz, plain, seconds, sentence } from "./static/format.js";
import { curve, layout } from "./static/layout.js";
import { SIZE, arrange, chord, emptyRing, geometry, outside, place } from "./static/ring.js";
import { adopt, applyPatch } from "./static/state.js";

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
