// Where modules, chords and names stand on the ring. A module keeps its place for as long as it is known.

export const SIZE = 1000;
export const CENTRE = SIZE / 2;

export function geometry(slots, compact) {
  const node = compact ? (slots <= 8 ? 104 : 62) : slots <= 8 ? 78 : slots <= 16 ? 62 : slots <= 32 ? 40 : 22;
  const small = node < 45; // then names stand outside of the ring
  return { node, ring: CENTRE - node - (small ? 130 : 26), slots, small };
}

// Where a name stands outside of a small node, and how it is aligned.
export function outside(at, { node, ring }) {
  const x = (at.x - CENTRE) / ring,
    y = (at.y - CENTRE) / ring;
  return {
    x: at.x + x * (node + 18),
    y: at.y + y * (node + 22) + 7,
    anchor: x > 0.25 ? "start" : x < -0.25 ? "end" : "middle",
  };
}

const angle = (slot, slots) => (slot / slots) * 2 * Math.PI - Math.PI / 2;

export function place(slot, { ring, slots }) {
  const at = angle(slot, slots);
  return { x: CENTRE + ring * Math.cos(at), y: CENTRE + ring * Math.sin(at) };
}

// A chord from edge to edge of two modules, bent towards the centre; `aside` shifts it, so that both directions show.
export function chord(a, b, node, aside) {
  const bend = {
    x: (a.x + b.x) / 2 + (CENTRE - (a.x + b.x) / 2) * 0.4,
    y: (a.y + b.y) / 2 + (CENTRE - (a.y + b.y) / 2) * 0.4,
  };
  const dx = b.x - a.x,
    dy = b.y - a.y,
    far = Math.hypot(dx, dy) || 1;
  const nx = (-dy / far) * aside,
    ny = (dx / far) * aside;
  const edge = (from) => {
    const ex = bend.x - from.x,
      ey = bend.y - from.y,
      length = Math.hypot(ex, ey) || 1;
    return { x: from.x + (ex / length) * (node + 10) + nx, y: from.y + (ey / length) * (node + 10) + ny };
  };
  const start = edge(a),
    end = edge(b),
    middle = { x: bend.x + nx, y: bend.y + ny };
  const at = (t) => ({
    x: (1 - t) ** 2 * start.x + 2 * t * (1 - t) * middle.x + t * t * end.x,
    y: (1 - t) ** 2 * start.y + 2 * t * (1 - t) * middle.y + t * t * end.y,
  });
  const text = (spot) => `${spot.x.toFixed(1)} ${spot.y.toFixed(1)}`;
  return { d: `M${text(start)}Q${text(middle)} ${text(end)}`, at };
}

// The slots of modules on a ring: one that has a slot keeps it, and a new one takes the free slot that is farthest from
// all others. When all are taken the ring gets more; the order around it stays. Slot 0, at the top, is this module's.
const SLOTS = [4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256];
export const emptyRing = () => ({ slots: SLOTS[0], places: new Map() });

export function arrange(ring, own, names) {
  if (ring.places.get(own) !== 0) ring.places = new Map([[own, 0]]);
  for (const name of [...ring.places.keys()]) if (name !== own && !names.includes(name)) ring.places.delete(name);
  for (const name of [...names].sort().filter((each) => !ring.places.has(each))) {
    if (ring.places.size === ring.slots) {
      const order = [...ring.places].sort(([, a], [, b]) => a - b);
      ring.slots = SLOTS.find((size) => size > order.length) ?? order.length + 1;
      ring.places = new Map(order.map(([each], at) => [each, Math.floor((at * ring.slots) / order.length)]));
    }
    const taken = [...ring.places.values()];
    const apart = (one, other) => (one - other + ring.slots) % ring.slots;
    const room = (slot) => Math.min(...taken.map((each) => Math.min(apart(slot, each), apart(each, slot))));
    const slots = Array.from({ length: ring.slots }, (_, slot) => slot);
    ring.places.set(
      name,
      slots.reduce((found, slot) => (room(slot) > room(found) ? slot : found)),
    );
  }
  return { slots: ring.slots, places: Object.fromEntries(ring.places) };
}
