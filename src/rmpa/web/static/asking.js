// Questions to the server, asked by a button, at once or again and again, and values that can be changed.

import { html, useEffect, useLayoutEffect, useRef, useState } from "./markup.js";
import { Failure, Mark, known, shape } from "./parts.js";

// A value that can be changed: a button, and once it is pressed a field, which has the cursor. Escape or a button
// leaves it, and the first button has the focus again. `save` gets the text and returns a promise: of `{ failure }`,
// and then the draft stays; else of `{ said }`, what has become of it.
export function Editable({ label, shown, begin, save, choices, children }) {
  const [draft, setDraft] = useState(null);
  const [state, set] = useState({});
  const place = useRef(),
    was = useRef(false);
  const open = draft !== null;
  useLayoutEffect(() => {
    if (open || was.current) place.current?.focus();
    if (open) place.current?.select?.();
    was.current = open;
  }, [open]);
  const leave = (next = {}) => {
    setDraft(null);
    set(next);
  };
  const submit = (event) => {
    event.preventDefault();
    set({ waits: true });
    save(place.current.value).then((done) => (done.failure ? set(done) : leave(done)));
  };
  if (!open)
    return html`<button
        ref=${place}
        type="button"
        class="field"
        aria-label=${`Change ${label}, now ${shown}`}
        onClick=${() => {
          setDraft(begin);
          set({});
        }}
      >
        ${shown}
      </button>
      <span role="status" class="muted said">${state.said}</span>`;
  const field = { ref: place, value: draft, onInput: (event) => setDraft(event.target.value) };
  const input = choices
    ? html`<select ...${field}>
        ${choices.map((each) => html`<option key=${each} value=${each}>${each}</option>`)}
      </select>`
    : html`<input ...${field} />`;
  return html`<form
    class="row edit"
    onSubmit=${submit}
    onKeyDown=${(event) => {
      if (event.key === "Escape") {
        event.stopPropagation();
        leave();
      }
    }}
  >
    <label><span>${label}</span>${input}</label><button class="primary" disabled=${state.waits}>Set</button>
    <button type="button" onClick=${() => leave()}>Leave</button>${children}<${Failure} failure=${state.failure} />
  </form>`;
}

// A question that a button asks: what has become of it (`waits`, `failure`, or what `made` makes of its answer), and
// the function that asks.
export function useAsk(connection, made = (value) => ({ value })) {
  const [state, set] = useState({});
  const ask = (what, args) => {
    set({ waits: true });
    return connection.ask(what, args).then(
      (value) => set(made(value)),
      (failure) => set({ failure }),
    );
  };
  return [state, ask, set];
}

// One question to the server, asked by a button or at once; `show` draws the answer.
export function Question({ connection, what, args, label, show, now }) {
  const [state, begin, set] = useAsk(connection);
  const ask = () => begin(what, args);
  useEffect(() => {
    if (now) ask();
    else set({});
  }, [what, JSON.stringify(args)]);
  return html`<div class="question">
    <button type="button" onClick=${ask} disabled=${state.waits}>${state.waits ? "Asking …" : label}</button>
    <div aria-live="polite">
      <${Failure} failure=${state.failure} />${state.value !== undefined && show(state.value)}
    </div>
  </div>`;
}

// Asks now, and again `period` seconds after each answer while the page is seen; 0: once. The first time it is asked in
// any case: a page may have been opened in the background. `ask` is given what says whether it is still wanted.
export function useAgain(on, period, key, ask) {
  useEffect(() => {
    if (!on) return undefined;
    let timer,
      ended = false;
    const turn = async (first) => {
      if (first || !document.hidden) await ask(() => !ended);
      if (period && !ended) timer = setTimeout(turn, period * 1000);
    };
    turn(true);
    return () => {
      ended = true;
      clearTimeout(timer);
    };
  }, [on, key]);
}

// The answer to a question, asked again every `period` seconds; `last` is the last one if there is none now. Another
// `key` asks anew.
export function useAnswer(connection, what, args, period = 0, key = "") {
  const [state, set] = useState({});
  useAgain(connection.phase === "open", period, JSON.stringify([what, args, key]), (wanted) =>
    connection
      .told(what, args)
      .then((told) => wanted() && set(({ last }) => ({ last: told.failure ? last : told.value, ...told }))),
  );
  return state;
}

const VERDICTS = { ok: "OK", warn: "WARN", fail: "ERROR", unknown: "STALE" };
const WORDS = {
  topic: ["It flows", "It does not flow"],
  service: ["It can be called", "It cannot be called"],
  module: ["It is reached", "It is not reached"],
};
const NO_DEMAND = "demand"; // the last stage where nothing is in the way, and no node wants it
function verdict({ kind, flows, stages }) {
  if (flows && stages?.at(-1)?.name === NO_DEMAND) return ["STALE", "Nothing prevents it, but no node subscribes"];
  const [well, ill] = WORDS[kind] || WORDS.topic;
  return flows ? ["OK", well] : ["ERROR", ill];
}

export function Diagnosis({ value }) {
  if (!Array.isArray(value) || !value.length) return html`<p class="empty">There is nothing to say.</p>`;
  return value.map(
    (one) =>
      html`<div class="diagnosis">
        <p>
          <${Mark} state=${verdict(one)[0]} word=${verdict(one)[1]} /> ${one.kind !== "module" &&
          one.node &&
          html` <span class="muted">from ${one.node}${one.peer && ` of ${one.peer}`} to ${one.to}</span>`}
        </p>
        <ol class="stages">
          ${(one.stages || []).map(
            (stage) =>
              html`<li class=${known(VERDICTS[stage.verdict]).tone}>
                <span class="stage"
                  ><svg viewBox="0 0 16 16" aria-hidden="true">${shape(VERDICTS[stage.verdict])}</svg
                  >${stage.name}</span
                >
                <span
                  ><span class="unseen">${stage.verdict}: </span>${stage.text}${stage.remedy &&
                  html`<br /><span class="remedy">${stage.remedy}</span>`}</span
                >
              </li>`,
          )}
        </ol>
      </div>`,
  );
}

export const Why = ({ connection, kind, name, peer, now }) =>
  html`<${Question}
    ...${{ connection, now }}
    what="why"
    args=${{ kind, name, ...(peer ? { peer } : {}) }}
    label="Why?"
    show=${(value) => html`<${Diagnosis} value=${value} />`}
  />`;
