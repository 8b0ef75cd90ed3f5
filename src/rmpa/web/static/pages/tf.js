// The frames of tf as a tree: parent, age, rate and sender of each transform, what is wrong, and one frame in another.

import { html, useEffect, useRef, useState } from "../markup.js";
import { count, duration, hertz } from "../format.js";
import { entries, section } from "../state.js";
import { Facts, Failure, Mark, Page, Panel, Select, useTick } from "../parts.js";
import { Table, useFilter } from "../lists.js";
import { ModuleLink, NodeLink } from "../links.js";
import { Frames, SILENT, angles, isLate } from "../frames.js";

const TYPES = ["tf2_msgs/TFMessage", "tf/tfMessage"];
const MOST = 4; // topics: a page may watch 16
const BEHIND = 1; // seconds between stamp and receipt
const SIMULATED = 1e8; // stamps below it are of a simulated clock

export const now = () => performance.now() / 1000;
export const transformTopics = (state) =>
  entries(state, "topics")
    .filter(([, one]) => TYPES.includes(one.type))
    .map(([name]) => name)
    .slice(0, MOST);

// The frames, kept up to date; `changed` is called when there are news.
export function useFrames(connection, state, changed) {
  const frames = useRef(),
    tell = useRef();
  frames.current ||= new Frames();
  tell.current = changed;
  const topics = transformTopics(state);
  const [failure, setFailure] = useState(null);
  useEffect(() => {
    setFailure(null);
    const ends = topics.map((topic) =>
      connection.watch({ topic, how: "tf", rate: 10 }, (message) => {
        if (message.op === "failed") setFailure(message);
        if (message.op !== "tf") return;
        frames.current.take(message, now());
        tell.current();
      }),
    );
    return () => ends.forEach((end) => end());
  }, [topics.join()]);
  return { frames: frames.current, failure, topics };
}

// Whether a node is in the graph; true of all where not all are known.
export function presence(state) {
  const nodes = section(state, "nodes");
  const known = Object.keys(nodes).length > 0 && !section(state, "hidden").nodes;
  return (name) => !known || name in nodes;
}

const ageOf = (edge) => now() - edge.heard;
const degrees = (radians) => `${((radians * 180) / Math.PI).toFixed(1)}°`;

// Rows of the tree below a frame, with their depth.
function* below(frames, children, name, depth, seen) {
  if (seen.has(name)) return;
  seen.add(name);
  yield { name, depth };
  for (const child of children.get(name) ?? []) yield* below(frames, children, child, depth + 1, seen);
}

function rowsOf(frames) {
  const children = frames.children,
    seen = new Set();
  const rows = frames.roots.flatMap((root) => [...below(frames, children, root, 0, seen)]);
  for (const name of frames.names) if (!seen.has(name)) rows.push(...below(frames, children, name, 0, seen)); // a loop
  return rows;
}

const COLUMNS = [
  [
    "Frame",
    ({ name, depth }) =>
      html`<span class="frame" style=${`padding-left:${Math.min(depth, 12) * 1.3}rem`}
          >${depth > 0 && html`<span class="branch" aria-hidden="true" />`}<span class="mono">${name}</span></span
        >
        <span class="unseen">, level ${depth + 1}</span>`,
  ],
  [
    "Parent",
    ({ holds }) => (holds ? html`<span class="mono">${holds.parent}</span>` : html`<span class="muted">a root</span>`),
  ],
  [
    "#Rate",
    ({ holds }) => (holds?.fixed ? html`<span class="muted">static</span>` : hertz(holds && Frames.rate(holds, now()))),
  ],
  ["#Age", ({ holds }) => (holds ? age(holds) : "–")],
  [
    "Sent by",
    ({ name, holds }, { frames, there }) =>
      [...(frames.edges.get(name)?.values() ?? [])].map(
        (edge) =>
          html`<div key=${edge.source} class=${there(edge.source) ? "" : "muted"}>
            <${NodeLink} name=${edge.source} />${!there(edge.source) && " has gone"}
            ${edge.parent !== holds.parent && html` <span class="muted">with the parent ${edge.parent}</span>`}
          </div>`,
      ),
  ],
  ["Module", ({ holds }, { own }) => holds && html`<${ModuleLink} name=${Frames.module(holds.source) || own} />`],
];

function age(edge) {
  if (edge.fixed) return html`<span class="muted">–</span>`;
  const old = ageOf(edge);
  if (isLate(edge, now())) return html`<${Mark} state="STALE" word=${duration(old)} />`;
  return `${old.toFixed(1)} s`;
}

const late = (behind) => `${duration(Math.abs(behind))} ${behind > 0 ? "behind" : "ahead of"}`;

export function FramesPage({ state, connection }) {
  const { frames, failure, topics } = useFrames(connection, state, () => {});
  useTick(0.5);
  const filter = useFilter("frame or node");
  const there = presence(state),
    own = section(state, "agent").name;
  const problems = frames.problems(now(), there);
  for (const name of frames.edges.keys()) {
    const edge = frames.edge(name);
    if (!edge.fixed && ageOf(edge) > SILENT)
      problems.push({ frame: name, level: "STALE", text: `was last sent ${duration(ageOf(edge))} ago` });
    const behind = edge.at - edge.stamp;
    if (!edge.fixed && edge.stamp > SIMULATED && Math.abs(behind) > BEHIND)
      problems.push({
        frame: name,
        level: "WARN",
        text: `has stamps ${late(behind)} the clock here, sent by ${edge.source}`,
      });
  }
  const rows = rowsOf(frames)
    .filter(({ name }) => filter.matches([name, ...(frames.edges.get(name)?.keys() ?? [])].join(" ")))
    .map((row) => ({ ...row, holds: frames.edge(row.name) }));
  return html`<${Page} title="Frames" kind=${topics.length ? `Transforms of ${topics.join(", ")}` : "Transforms"}>
    <${Failure} failure=${failure} />
    ${problems.length > 0 &&
    html`<${Panel} title="What is wrong"
      ><ul>
        ${problems
          .slice(0, 20)
          .map(
            ({ frame, level, text }) =>
              html`<li key=${frame + text}>
                <${Mark} state=${level} word="" /> <strong class="mono">${frame}</strong> ${text}
              </li>`,
          )}
        ${problems.length > 20 && html`<li class="muted">and ${count(problems.length - 20)} more</li>`}
      </ul><//
    >`}
    <${Panel} title=${`${count(frames.names.length)} frames`} aside=${filter.field}
      ><${Table}
        caption="Frames"
        columns=${COLUMNS}
        about=${{ frames, own, there }}
        empty=${topics.length ? "No transform has come." : "No topic has the type tf2_msgs/TFMessage."}
        list=${rows}
    /><//>
    ${frames.names.length > 1 && html`<${Between} frames=${frames} />`}<//
  >`;
}

// What one frame is in another, as tf_echo prints it.
function Between({ frames }) {
  const { names } = frames;
  const [target, setTarget] = useState(frames.roots[0] ?? names[0]);
  const [frame, setFrame] = useState(names.find((name) => name !== target));
  const found = frames.lookup(target, frame);
  const digits = (value) => value.toFixed(4);
  const metres = (value) => `${value.toFixed(3)} m`;
  const pose = found.pose;
  return html`<${Panel} title="One frame in another">
    <div class="form">
      <div class="row">
        <${Select} label="Frame" value=${frame} names=${names} onChange=${setFrame} />
        <${Select} label="in" value=${target} names=${names} onChange=${setTarget} />
      </div>
      ${found.problem
        ? html`<p><${Mark} state="WARN" word=${found.problem} /></p>`
        : html`<${Facts}
            rows=${[
              ["x, y, z", pose.slice(0, 3).map(metres).join(", ")],
              ["Roll, pitch, yaw", angles(pose).map(degrees).join(", ")],
              ["Quaternion x, y, z, w", pose.slice(3).map(digits).join(", ")],
              ["Distance", metres(Math.hypot(...pose.slice(0, 3)))],
              ["By way of", found.edges.map((edge) => edge.child).join(", ")],
            ]}
          />`}
    </div><//
  >`;
}
