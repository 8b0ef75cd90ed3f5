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

// Edges that close a cycle are turned: a depth-first walk, from those that have the most outputs and no input.
function acyclic(ids, edges) {
  const out = new Map(ids.map((id) => [id, []])),
    degree = new Map(ids.map((id) => [id, 0]));
  for (const edge of edges) {
    out.get(edge.from).push(edge);
    degree.set(edge.from, degree.get(edge.from) - 1);
    degree.set(edge.to, degree.get(edge.to) + 1);
  }
  const place = new Map(ids.map((id, at) => [id, at]));
  const starts = [...ids].sort((a, b) => degree.get(a) - degree.get(b) || place.get(a) - place.get(b));
  const state = new Map();
  for (const start of starts) {
    if (state.has(start)) continue;
    const stack = [[start, 0]];
    state.set(start, 1);
    while (stack.length) {
      const top = stack[stack.length - 1];
      const edge = out.get(top[0])[top[1]++];
      if (!edge) {
        state.set(top[0], 2);
        stack.pop();
      } else if (state.get(edge.to) === 1) edge.turned = true;
      else if (!state.has(edge.to)) {
        state.set(edge.to, 1);
        stack.push([edge.to, 0]);
      }
    }
  }
}

// The column of each vertex; what only sends stands directly before what it sends to.
function ranks(ids, edges) {
  const after = new Map(ids.map((id) => [id, []])),
    before = new Map(ids.map((id) => [id, 0]));
  for (const { from, to, turned } of edges) {
    const [a, b] = turned ? [to, from] : [from, to];
    after.get(a).push(b);
    before.set(b, before.get(b) + 1);
  }
  const rank = new Map(ids.map((id) => [id, 0]));
  const left = new Map(before);
  const queue = ids.filter((id) => !left.get(id));
  for (let at = 0; at < queue.length; at++)
    for (const next of after.get(queue[at])) {
      rank.set(next, Math.max(rank.get(next), rank.get(queue[at]) + 1));
      left.set(next, left.get(next) - 1);
      if (!left.get(next)) queue.push(next);
    }
  for (const id of ids)
    if (!before.get(id) && after.get(id).length)
      rank.set(id, Math.min(...after.get(id).map((next) => rank.get(next))) - 1);
  return rank;
}

// Where many cycles make long chains, each vertex stands as near to the sources as it can instead, and the edges that
// lead back are turned.
function nearest(ids, edges) {
  const after = new Map(ids.map((id) => [id, []])),
    inputs = new Map(ids.map((id) => [id, 0]));
  for (const { from, to } of edges) {
    after.get(from).push(to);
    inputs.set(to, inputs.get(to) + 1);
  }
  const rank = new Map();
  const starts = [...ids].sort((a, b) => inputs.get(a) - inputs.get(b));
  let queue = starts.filter((id) => !inputs.get(id));
  for (const id of queue) rank.set(id, 0);
  for (const start of [...starts.slice(0, 1), ...starts]) {
    if (!queue.length && !rank.has(start)) {
      queue = [start];
      rank.set(start, 0);
    }
    for (let at = 0; at < queue.length; at++)
      for (const next of after.get(queue[at]))
        if (!rank.has(next)) {
          rank.set(next, rank.get(queue[at]) + 1);
          queue.push(next);
        }
    queue = [];
  }
  for (const edge of edges) edge.turned = rank.get(edge.to) < rank.get(edge.from);
  return rank;
}

// A column with many vertices of one lane becomes several, so that the whole is as wide as it is high.
function split(ids, rank, known) {
  const lanes = new Set(ids.map((id) => known.get(id).lane)).size;
  const most = Math.max(5, Math.ceil(Math.sqrt(SHAPE * ids.length) / lanes));
  const counts = new Map(),
    parts = new Map(),
    widest = [];
  for (const id of ids) {
    const key = `${rank.get(id)} ${known.get(id).lane}`;
    const number = counts.get(key) || 0;
    counts.set(key, number + 1);
    parts.set(id, Math.floor(number / most));
    widest[rank.get(id)] = Math.max(widest[rank.get(id)] || 0, parts.get(id));
  }
  let sum = 0;
  const first = Array.from(widest, (wide = 0) => {
    const at = sum;
    sum += wide + 1;
    return at;
  });
  return new Map(ids.map((id) => [id, first[rank.get(id)] + parts.get(id)]));
}

// Pairs of edges that cross: inversions of their ends, counted as they are inserted in order.
function crossings(columns, place, before) {
  let sum = 0;
  for (const column of columns) {
    const ends = column.flatMap((one) =>
      (before.get(one) || []).map((other) => place.get(other)).sort((a, b) => a - b),
    );
    const seen = [];
    for (const end of ends) {
      let low = 0,
        high = seen.length;
      while (low < high) {
        const middle = (low + high) >> 1;
        if (seen[middle] <= end) low = middle + 1;
        else high = middle;
      }
      sum += seen.length - low;
      seen.splice(low, 0, end);
    }
  }
  return sum;
}

// Columns of vertices and dummies, in the order of their lanes and, within, of few crossings.
function order(columns, before, after, lane) {
  const place = new Map();
  const number = () => columns.forEach((column) => column.forEach((one, at) => place.set(one, at / column.length)));
  number();
  let best = columns.map((column) => [...column]),
    fewest = crossings(columns, place, before);
  for (let sweep = 0; sweep < SWEEPS && fewest; sweep++) {
    const down = sweep % 2 === 0;
    for (const column of down ? columns : [...columns].reverse()) {
      const wanted = new Map(
        column.map((one) => {
          const near = (down ? before : after).get(one) || [];
          return [
            one,
            near.length ? near.reduce((sum, each) => sum + place.get(each), 0) / near.length : place.get(one),
          ];
        }),
      );
      column.sort((a, b) => lane(a) - lane(b) || wanted.get(a) - wanted.get(b) || place.get(a) - place.get(b));
      column.forEach((one, at) => place.set(one, at / column.length));
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
  const inputs = new Map(),
    outputs = new Map();
  const columns = Array.from({ length: Math.max(0, ...rank.values()) + 1 }, () => []);
  for (const id of ids) columns[rank.get(id)].push(id);
  const join = (a, b) => {
    if (!outputs.has(a)) outputs.set(a, []);
    if (!inputs.has(b)) inputs.set(b, []);
    outputs.get(a).push(b);
    inputs.get(b).push(a);
  };
  links.forEach((edge, number) => {
    const [a, b] = edge.turned ? [edge.to, edge.from] : [edge.from, edge.to];
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
  for (const { parts, low, high } of bands)
    for (const part of parts) {
      const start = (low + high - height(part)) / 2;
      let sum = start;
      for (const id of part) {
        y.set(id, sum + boxes.get(id).h / 2);
        sum += boxes.get(id).h + GAP.row;
      }
    }
  for (let turn = 0; turn < ALIGNS; turn++)
    for (const { parts, low, high } of bands)
      for (const part of turn % 2 ? [...parts].reverse() : parts) {
        if (!part.length) continue;
        const wanted = part.map((id) => {
          const near = [...(inputs.get(id) || []), ...(outputs.get(id) || [])].map((other) => y.get(other));
          return near.length ? near.reduce((all, each) => all + each, 0) / near.length : y.get(id);
        });
        settle(
          wanted,
          part.map((id) => boxes.get(id).h),
          low,
          high,
        ).forEach((at, index) => y.set(part[index], at));
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
  return {
    at,
    paths,
    lanes: bands.map(({ name, y: from, h }) => ({ name, y: from, h })),
    width,
    height: top - GAP.lane,
  };
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
