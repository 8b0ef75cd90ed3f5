// Whether what is shown as live is old, and how old: one rule for values, plots, pictures and maps. How long a topic
// may be silent is told by the server (`after` of a beat); routes it judges itself by the same rule (`stopped`).

import { html, useEffect, useRef, useState } from "./markup.js";
import { bandwidth, duration, hertz } from "./format.js";
import { Mark, useTick } from "./parts.js";

// `came`: when the last message came, by performance.now(); `after`: seconds, 0 while no period is known.
export const isOld = (came, after) => after > 0 && performance.now() - came >= after * 1000;

export function useOld(came, after) {
  const [, wake] = useState(0);
  useEffect(() => {
    if (!came || !after || isOld(came, after)) return undefined;
    const timer = setTimeout(() => wake((n) => n + 1), came + after * 1000 - performance.now() + 1);
    return () => clearTimeout(timer);
  }, [came, after]);
  return isOld(came, after);
}

// The messages of a topic as `connection.watch` gives them: `take` gets each; `null` as `wanted` asks for none.
export function useWatch(connection, wanted, take) {
  const [state, set] = useState({ came: 0 });
  const key = JSON.stringify(wanted);
  const sink = useRef(take);
  sink.current = take;
  useEffect(() => {
    if (!wanted) return undefined;
    set((before) => (before.topic === wanted.topic ? before : { came: 0, topic: wanted.topic }));
    return connection.watch(wanted, (message) => {
      if (message.op === "failed") return set({ came: 0, topic: wanted.topic, failure: message });
      if (message.op === "beat") return set((before) => ({ ...before, beat: message }));
      set((before) => ({ ...before, failure: undefined, came: performance.now() }));
      return sink.current(message);
    });
  }, [key]);
  return state;
}

const Ago = ({ came }) => {
  useTick(1);
  return duration((performance.now() - came) / 1000);
};

// What is live, with its rate and age below; greyed once it is old. `onOld` is told of each change of that.
export function Fresh({ watched: { came, beat }, onOld, children }) {
  const old = useOld(came, beat?.after);
  useEffect(() => onOld?.(old), [old]);
  const figures = beat && `${hertz(beat.rate)} · ${bandwidth(beat.bandwidth)}`;
  const before = old ? "the last message is " : `${figures || "one message"} · `;
  return html`<div class=${old ? "fresh old" : "fresh"}>
    ${children}
    ${came > 0 &&
    html`<p class="muted beat">
      <span role="status">${old && html`<${Mark} state="STALE" word="Nothing comes any more" />, `}</span
      >${before}<${Ago} came=${came} />${` old${old && figures ? `, before that ${figures}` : ""}`}
    </p>`}
  </div>`;
}
