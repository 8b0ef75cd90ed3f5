// Where the vertices of a directed graph stand: columns by rank, a lane for each group, few crossings. No DOM.
//
// Longest-path ranks on the graph without its cycles, one dummy in each column that an edge passes, barycentre sweeps
// of which the order with the fewest crossings stays, and then each column as near to its neighbours as its order
// allows. Vertices that were there before keep their order, so that a graph that grows does not jump.

const GAP = { column: 48, row: 12, lane: 18, title: 24 };
const COLUMNS = 17; // more are not read at one look
const SHAPE = 8; // rows to a column: boxes are wide, and so are screens
const SWEEPS = 8;
const ALIGNS = 6;

// What each of `ids` has, by the pair of it and something that `of` makes of each item.
function lists(ids, items, of) {
  const made = new Map(ids.map((id) => [id, []]));
  for (const [id, each] of items.map(of)) made.get(id).push(each);
  return made;
}
const mean = (list) => list.reduce((sum, each) => sum + each, 0) / list.length;
const ends = ({ from, to, turned }) => (turned ? [to, from] : [from, to]);

// Edges that close a cycle are turned: a depth-first walk, from those that have the most outputs and no input.
function acyclic(ids, edges) {
  const out = lists(ids, edges, (edge) => [edge.from, edge]);
  const inputs = lists(ids, edges, ({ from, to }) => [to, from]);
  const degree = (id) => inputs.get(id).length - out.get(id).length;
  const open = new Map();
  const visit = (id) => {
    open.set(id, true);
    for (const edge of out.get(id))
      if (open.get(edge.to)) edge.turned = true;
      else if (!open.has(edge.to)) visit(edge.to);
    open.set(id, false);
  };
  for (const id of [...ids].sort((a, b) => degree(a) - degree(b))) if (!open.has(id)) visit(id);
}

// The column of each vertex: the longest way to it; what only sends stands directly before what it sends to.
function ranks(ids, edges) {
  const after = lists(ids, edges, ends);
  const before = lists(ids, edges, (edge) => ends(edge).reverse());
  const rank = new Map();
  const of = (id) => {
    if (!rank.has(id)) rank.set(id, Math.max(-1, ...before.get(id).map(of)) + 1);
    return rank.get(id);
  };
  ids.forEach(of);
  for (const id of ids)
    if (!before.get(id).length && after.get(id).length) rank.set(id, Math.min(...after.get(id).map(of)) - 1);
  return rank;
}

// Where many cycles make long chains, each vertex stands as near to the sources as it can instead, and the edges that
// lead back are turned.
function nearest(ids, edges) {
  const after = lists(ids, edges, ({ from, to }) => [from, to]);
  const before = lists(ids, edges, ({ from, to }) => [to, from]);
  const rank = new Map();
  const spread = (queue) => {
    for (const id of queue) rank.set(id, 0);
    for (const id of queue)
      for (const next of after.get(id)) if (!rank.has(next)) rank.set(queue[queue.push(next) - 1], rank.get(id) + 1);
  };
  const starts = [...ids].sort((a, b) => before.get(a).length - before.get(b).length);
  spread(starts.filter((id) => !before.get(id).length));
  for (const id of starts) if (!rank.has(id)) spread([id]);
  for (const edge of edges) edge.turned = rank.get(edge.to) < rank.get(edge.from);
  return rank;
}

// A column with many vertices of one lane becomes several, so that the whole is as wide as it is high.
function split(ids, rank, known) {
  const lane = (id) => known.get(id).lane;
  const most = Math.max(5, Math.ceil(Math.sqrt(SHAPE * ids.length) / new Set(ids.map(lane)).size));
  const counts = new Map(),
    part = new Map(),
    first = [0]; // of the columns of each rank
  for (const id of ids) {
    const key = `${rank.get(id)} ${lane(id)}`;
    counts.set(key, (counts.get(key) ?? -1) + 1);
    part.set(id, Math.floor(counts.get(key) / most));
  }
  for (let at = 0; at <= Math.max(0, ...rank.values()); at++)
    first.push(first[at] + Math.max(0, ...ids.filter((id) => rank.get(id) === at).map((id) => part.get(id))) + 1);
  return new Map(ids.map((id) => [id, first[rank.get(id)] + part.get(id)]));
}

// Pairs of edges that cross: inversions of their ends, counted as they are inserted in order.
function crossings(columns, place, before) {
  let sum = 0;
  for (const column of columns) {
    const seen = [];
    for (const one of column)
      for (const end of (before.get(one) || []).map((other) => place.get(other)).sort((a, b) => a - b)) {
        const at = seen.findLastIndex((each) => each <= end) + 1;
        sum += seen.length - at;
        seen.splice(at, 0, end);
      }
  }
  return sum;
}

// Columns of vertices and dummies, in the order of their lanes and, within, of few crossings.
function order(columns, before, after, lane) {
  const place = new Map();
  const number = (column) => column.forEach((one, at) => place.set(one, at / column.length));
  columns.forEach(number);
  let best = columns.map((column) => [...column]),
    fewest = crossings(columns, place, before);
  for (let sweep = 0; sweep < SWEEPS && fewest; sweep++) {
    const down = sweep % 2 === 0;
    for (const column of down ? columns : [...columns].reverse()) {
      const near = (one) => ((down ? before : after).get(one) || []).map((other) => place.get(other));
      const wanted = new Map(column.map((one) => [one, near(one).length ? mean(near(one)) : place.get(one)]));
      column.sort((a, b) => lane(a) - lane(b) || wanted.get(a) - wanted.get(b) || place.get(a) - place.get(b));
      number(column);
    }
    const now = crossings(columns, place, before);
    if (now < fewest) [fewest, best] = [now, columns.map((column) => [...column])];
  }
  return best;
}

// The places nearest to what each wants that keep order and distance (pool adjacent violators).
function settle(wanted, sizes, low, high) {
  const offsets = [];
  sizes.reduce((sum, size, at) => ((offsets[at] = sum), sum + size + GAP.row), 0);
  const pools = [];
  wanted.forEach((want, at) => {
    pools.push({ sum: want - sizes[at] / 2 - offsets[at], count: 1 });
    while (pools.length > 1) {
      const [a, b] = pools.slice(-2);
      if (a.sum / a.count <= b.sum / b.count) break;
      pools.splice(-2, 2, { sum: a.sum + b.sum, count: a.count + b.count });
    }
  });
  const most = high - low - (offsets.at(-1) + sizes.at(-1));
  return pools
    .flatMap(({ sum, count }) => new Array(count).fill(Math.max(low, Math.min(low + most, sum / count))))
    .map((start, at) => start + offsets[at] + sizes[at] / 2);
}

// `vertices`: { id, lane, w, h }; `lanes`: names from top to bottom; `edges`: { from, to }; `before`: the layout of a
// moment ago. Returns the centre of each vertex, the points of each edge, the box of each lane, and the whole size.
export function layout(vertices, edges, lanes, before, gap = GAP.column) {
  const past = (id) => before?.at.get(id)?.y ?? Infinity;
  const ids = vertices.map((each) => each.id).sort((a, b) => past(a) - past(b) || (a < b ? -1 : 1));
  const known = new Map(vertices.map((each) => [each.id, each]));
  const links = edges.filter(({ from, to }) => from !== to).map((edge) => ({ ...edge }));
  acyclic(ids, links);
  let rank = ranks(ids, links);
  if (Math.max(0, ...rank.values()) >= COLUMNS) rank = nearest(ids, links);
  const left = (id) => before?.at.get(id)?.x ?? Infinity;
  rank = split(
    [...ids].sort((a, b) => (left(a) < left(b) ? -1 : left(a) > left(b) ? 1 : 0)),
    rank,
    known,
  );
  const boxes = new Map(known);
  const [inputs, outputs] = [new Map(), new Map()];
  const columns = Array.from({ length: Math.max(0, ...rank.values()) + 1 }, () => []);
  for (const id of ids) columns[rank.get(id)].push(id);
  const add = (map, key, value) => map.set(key, [...(map.get(key) || []), value]);
  const join = (a, b) => {
    add(outputs, a, b);
    add(inputs, b, a);
  };
  links.forEach((edge, number) => {
    const [a, b] = ends(edge);
    edge.chain = [a];
    for (let at = rank.get(a) + 1; at < rank.get(b); at++) {
      const dummy = `\u0000${number} ${at}`;
      boxes.set(dummy, { id: dummy, lane: known.get(a).lane, w: 0, h: 2 });
      columns[at].push(dummy);
      join(edge.chain.at(-1), dummy);
      edge.chain.push(dummy);
    }
    if (rank.get(a) !== rank.get(b)) join(edge.chain.at(-1), b);
    edge.chain.push(b);
  });
  const lane = (id) => lanes.indexOf(boxes.get(id).lane);
  for (const column of columns) column.sort((a, b) => lane(a) - lane(b));
  const ordered = order(columns, inputs, outputs, lane);
  return drawn({ ordered, lanes, boxes, inputs, outputs, links, known, gap });
}

function drawn({ ordered, lanes, boxes, inputs, outputs, links, known, gap }) {
  const height = (list) => list.reduce((sum, id) => sum + boxes.get(id).h + GAP.row, -GAP.row);
  const bands = [];
  let top = 0;
  for (const name of lanes) {
    const parts = ordered.map((column) => column.filter((id) => boxes.get(id).lane === name));
    if (!parts.some((part) => part.some((id) => known.has(id)))) continue;
    const tall = Math.max(...parts.map(height), 30);
    bands.push({ name, parts, y: top, low: top + GAP.title, high: top + GAP.title + tall, h: tall + GAP.title + 12 });
    top += tall + GAP.title + 12 + GAP.lane;
  }
  const y = new Map();
  for (let turn = -1; turn < ALIGNS; turn++)
    for (const { parts, low, high } of bands)
      for (const part of turn % 2 ? [...parts].reverse() : parts) {
        const wanted = part.map((id) => {
          const near = [...(inputs.get(id) || []), ...(outputs.get(id) || [])].map((other) => y.get(other));
          if (turn < 0) return (low + high) / 2;
          return near.length ? mean(near) : y.get(id);
        });
        const sizes = part.map((id) => boxes.get(id).h);
        settle(wanted, sizes, low, high).forEach((at, index) => y.set(part[index], at));
      }
  const x = [];
  let right = 16;
  for (const column of ordered) {
    const wide = Math.max(...column.map((id) => boxes.get(id).w), 0);
    x.push(right + wide / 2);
    right += wide + gap;
  }
  const at = new Map();
  ordered.forEach((column, index) => column.forEach((id) => at.set(id, { x: x[index], y: y.get(id) })));
  const paths = links.map((edge) => ({ ...edge, points: points(edge, at, boxes) }));
  for (const id of [...at.keys()]) if (!known.has(id)) at.delete(id);
  const width = Math.max(right - gap + 16, 120);
  return { at, paths, lanes: bands, width, height: top - GAP.lane };
}

// From the side of the one box to the side of the other, through the dummies.
function points({ chain, turned }, at, boxes) {
  const last = chain.length - 1;
  const found = chain.map((id, index) => {
    const { x, y } = at.get(id);
    const half = boxes.get(id).w / 2;
    return { x: index === 0 ? x + half : index === last ? x - half : x, y };
  });
  if (found.length === 2 && found[1].x < found[0].x) found[1].x = found[0].x; // of one column: a bow beside it
  return turned ? found.reverse() : found;
}

export function curve(line) {
  const text = (spot) => `${spot.x.toFixed(1)} ${spot.y.toFixed(1)}`;
  let d = `M${text(line[0])}`;
  for (let at = 1; at < line.length; at++) {
    const a = line[at - 1],
      b = line[at],
      middle = a.x === b.x ? a.x + 40 : (a.x + b.x) / 2;
    d += `C${text({ x: middle, y: a.y })} ${text({ x: middle, y: b.y })} ${text(b)}`;
  }
  return d;
}
