// Small parts that all pages are made of.

import { Component, createContext, html, useContext, useEffect, useLayoutEffect, useRef, useState } from "./markup.js";
import { ago, count, plain } from "./format.js";

// Each state and level has a word, a colour (by its class) and a shape: none of them is needed to tell them apart.
export const STATES = {
  here: { word: "this module", tone: "accent" },
  up: { word: "up", tone: "good" },
  silent: { word: "silent", tone: "warn" },
  linking: { word: "no link", tone: "warn" },
  refused: { word: "refused", tone: "bad" },
  relayed: { word: "relayed", tone: "good" },
  away: { word: "away", tone: "idle" },
  lost: { word: "link lost", tone: "bad" },
  pending: { word: "pending", tone: "warn" },
  revoked: { word: "revoked", tone: "bad" },
  foreign: { word: "foreign", tone: "idle" },
  OK: { word: "OK", tone: "good" },
  WARN: { word: "warning", tone: "warn" },
  ERROR: { word: "error", tone: "bad" },
  STALE: { word: "stale", tone: "idle" },
  "": { word: "not known", tone: "idle" },
};

const SHAPES = {
  here: html`<path class="fill" d="M8 1.5 14.5 8 8 14.5 1.5 8Z" />`,
  up: html`<circle class="fill" cx="8" cy="8" r="5.5" />`,
  silent: html`<circle class="stroke" cx="8" cy="8" r="5.5" stroke-dasharray="3.4 2.4" />`,
  linking: html`<circle class="stroke" cx="8" cy="8" r="5.5" /><path class="fill" d="M8 2.5a5.5 5.5 0 0 1 0 11Z" />`,
  refused: html`<path class="stroke heavy" d="M3 3l10 10M13 3 3 13" />`,
  relayed: html`<circle class="stroke" cx="8" cy="8" r="6" /><circle class="fill" cx="8" cy="8" r="3" />`,
  away: html`<path class="stroke" d="M8 2 14 8 8 14 2 8Z" />`,
  lost: html`<path class="stroke heavy" d="M1.5 8H6M10 8h4.5M6 4.5v7M10 4.5v7" />`,
  pending: html`<circle class="stroke" cx="8" cy="8" r="6" stroke-dasharray="2.4 2.3" /><path
      class="stroke"
      d="M8 5v6M5 8h6"
    />`,
  revoked: html`<circle class="stroke" cx="8" cy="8" r="6" /><path class="stroke" d="M4 12 12 4" />`,
  foreign: html`<path class="stroke" d="M3 3h10v10H3Z" />`,
  OK: html`<path class="stroke heavy" d="M2.5 8.5 6.5 12.5 13.5 4" />`,
  WARN: html`<path class="fill" d="M8 1.5 15 14H1Z" />`,
  ERROR: html`<path class="fill" d="M5 1.5h6L14.5 5v6L11 14.5H5L1.5 11V5Z" />`,
  STALE: html`<circle class="stroke" cx="8" cy="8" r="6" /><path class="stroke" d="M8 4.5V8l2.5 2" />`,
  "": html`<path class="stroke" d="M3 8h10" />`,
};

export const shape = (state) => SHAPES[state] || SHAPES[""];
export const known = (state) => STATES[state] || STATES[""];

export function Mark({ state, word }) {
  const about = known(state);
  return html`<span class="mark ${about.tone}"
    ><svg viewBox="0 0 16 16" aria-hidden="true">${shape(state)}</svg>${word === undefined ? about.word : word}</span
  >`;
}

// Draws again only when one of its properties is another object.
export function memo(draw) {
  return class extends Component {
    shouldComponentUpdate(next) {
      const before = this.props;
      const keys = Object.keys(next);
      return (
        keys.length !== Object.keys(before).length ||
        keys.some((key) => key !== "children" && next[key] !== before[key])
      );
    }
    render(props) {
      return draw(props);
    }
  };
}

export const href = (page, name) => (name === undefined ? `#/${page}` : `#/${page}/${encodeURIComponent(name)}`);
export const Link = ({ page, name, children }) => html`<a href=${href(page, name)}>${children || name}</a>`;

export function Facts({ rows }) {
  const shown = rows.filter(([, value]) => value !== undefined && value !== null && value !== "" && value !== "–");
  return html`<dl class="facts">
    ${shown.map(
      ([name, value]) =>
        html`<div key=${name}>
          <dt>${name}</dt>
          <dd>${value}</dd>
        </div>`,
    )}
  </dl>`;
}

// Of this entry of the browser's history: *Back* brings the page as it was left, and a link opens it anew.
export const kept = () => history.state || {};
export function keep(values) {
  try {
    history.replaceState({ ...kept(), ...values }, "");
  } catch {
    // a browser allows so many in some seconds
  }
}
// A state that stays with the entry; `first` where the entry has none.
export function useKept(key, first) {
  const [value, set] = useState(() => kept()[key] ?? first);
  const change = (next) => {
    keep({ [key]: next });
    set(next);
  };
  return [value, change];
}

// A field by which a list is filtered, and whether a text has what is typed there.
export function useFilter(by, first = "") {
  const [text, setText] = useKept("filter", first);
  const field = html`<input
    class="filter"
    type="search"
    placeholder=${`Filter by ${by}`}
    aria-label=${`Filter by ${by}`}
    value=${text}
    onInput=${(event) => setText(event.target.value)}
  />`;
  const typed = text.toLowerCase();
  return { field, typed, matches: (each) => each.toLowerCase().includes(typed) };
}

const SOON = 40; // entries that fill a screen
const MOST = 200; // entries of a list that are drawn at first, and more with each press of a button

// The first entries of a list, and the button for more of them, where there are more. `key` tells apart the lists of a
// page. A few are drawn at once, and the rest when the browser has shown them.
export function useFirst(list, key = "") {
  const [most, setMost] = useKept(`most ${key}`, MOST);
  const [drawn, setDrawn] = useState(kept().scroll || list.length <= SOON ? Infinity : SOON);
  useEffect(() => {
    if (drawn !== Infinity) setTimeout(() => setDrawn(Infinity));
  }, []);
  const left = list.length - most;
  const more =
    left > 0 &&
    html`<p class="more">
      <button type="button" onClick=${() => setMost(most + MOST)}>
        Show ${Math.min(MOST, left)} more of ${count(left)}
      </button>
    </p>`;
  return [left > 0 || drawn < list.length ? list.slice(0, Math.min(most, drawn)) : list, more];
}

// Entries by what a column has of them; what is not known comes last, whichever way it is sorted.
export function sorted(list, of, down) {
  const unknown = (value) => value === undefined || value === null || value === "";
  const compare = (a, b) => (typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(b));
  return list
    .map((each) => [of(each), each])
    .sort(([a], [b]) => unknown(a) - unknown(b) || (unknown(a) ? 0 : down ? compare(b, a) : compare(a, b)))
    .map(([, each]) => each);
}

function Heading({ column, sort, onSort }) {
  const number = column.startsWith("#"),
    text = column.replace("#", "");
  const here = sort?.column === column;
  return html`<th
    scope="col"
    class=${number ? "number" : ""}
    aria-sort=${here ? (sort.down ? "descending" : "ascending") : undefined}
  >
    ${onSort
      ? html`<button
          type="button"
          class="field sort"
          onClick=${() => onSort({ column, down: here ? !sort.down : number })}
        >
          ${text}<span aria-hidden="true">${here ? (sort.down ? " ▼" : " ▲") : ""}</span>
        </button>`
      : text || html`<span class="unseen">Action</span>`}
  </th>`;
}

// Its children are its rows; or, of a list that may be long, the function that draws one of `list`. It can be sorted by
// the columns of which `keys` has what an entry has there.
export function Table({ caption, columns, list, children, empty, keys = {} }) {
  const [sort, setSort] = useKept(`sort ${caption}`);
  const of = sort && keys[sort.column];
  const [first, more] = useFirst(of ? sorted(list, of, sort.down) : list || [children].flat(), caption);
  const rows = list ? first.map(children) : first;
  if (!rows.filter(Boolean).length) return html`<p class="empty">${empty || "Nothing here."}</p>`;
  return html`<div class="scroll" tabindex="0" role="region" aria-label=${caption}>
    <table>
      <caption class="unseen">
        ${caption}
      </caption>
      <thead>
        <tr>
          ${columns.map(
            (column) =>
              html`<${Heading} key=${column} column=${column} sort=${sort} onSort=${keys[column] && setSort} />`,
          )}
        </tr>
      </thead>
      <tbody>
        ${rows}
      </tbody>
    </table>
    ${more}
  </div>`;
}

export const Panel = ({ title, children, aside, wide }) =>
  html`<section class=${wide ? "panel wide" : "panel"}>
    ${title &&
    html`<header>
      <h2>${title}</h2>
      ${aside}
    </header>`}${children}
  </section>`;

// Set where a page is shown as a panel beside others.
export const AsPanel = createContext(false);

export const Page = ({ title, kind, aside, children }) => {
  const heading = useRef(),
    panel = useContext(AsPanel);
  useEffect(() => {
    if (!panel) document.title = `${plain(title)} · RMPA`;
  }, [title]);
  if (panel) return html`<div>${aside && html`<div class="actions">${aside}</div>`}${children}</div>`;
  return html`<div class="page">
    <header class="title">
      <div>
        ${kind && html`<p class="kind">${kind}</p>`}
        <h1 ref=${heading} tabindex="-1">${title}</h1>
      </div>
      <div class="actions">${aside}</div>
    </header>
    ${children}
  </div>`;
};

export const Gone = ({ kind, name }) =>
  html`<p class="empty">
    There is no ${kind} <code>${name}</code> at present. It is shown here as soon as there is one.
  </p>`;

export const Failure = ({ failure }) =>
  failure &&
  html`<p class="failure" role="alert">
    <${Mark} state="ERROR" word="" /> ${failure.error}
    ${failure.code && ` [${failure.code}]`}${failure.remedy && html`<br /><span class="muted">${failure.remedy}</span>`}
  </p>`;

// A time that has passed; it counts by itself, once a second.
export function Since({ moment, text }) {
  const [, tick] = useState(0);
  useEffect(() => {
    const timer = setInterval(() => tick((n) => n + 1), 1000);
    return () => clearInterval(timer);
  }, []);
  return html`<time datetime=${new Date(moment * 1000).toISOString()}>${text ? text(ago(moment)) : ago(moment)}</time>`;
}

export const Uptime = ({ since }) => html`<${Since} moment=${since} text=${(shown) => shown} />`;

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

// One question to the server, asked by a button or at once; `show` draws the answer.
export function Question({ connection, what, args, label, show, now }) {
  const [state, set] = useState({});
  const ask = () => {
    set({ waits: true });
    connection.ask(what, args).then(
      (value) => set({ value }),
      (failure) => set({ failure }),
    );
  };
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

// The answer to a question, asked again every `period` seconds while the page is seen; 0: once. Another `key` asks
// anew. The first time it is asked in any case: a page may have been opened in the background.
export function useAnswer(connection, what, args, period = 0, key = "") {
  const [state, set] = useState({});
  const open = connection.phase === "open";
  useEffect(() => {
    if (!open) return undefined;
    let ended = false,
      timer;
    const ask = async (first) => {
      if (first || !document.hidden) {
        const next = await connection.ask(what, args).then(
          (value) => ({ value }),
          (failure) => ({ failure }),
        );
        if (ended) return;
        set(next);
      }
      if (period && !ended) timer = setTimeout(ask, period * 1000);
    };
    ask(true);
    return () => {
      ended = true;
      clearTimeout(timer);
    };
  }, [what, JSON.stringify(args), key, open]);
  return state;
}

// A node as it is named in the state: `MODULE:/name` for a peer's. People read the name that the graph of this module
// has, as in rosnode, rosbridge and Foxglove: its proxy's, `/rmpa/MODULE/name`.
export const nodeKey = (module, node) => (module ? `${module}:${node}` : node);
export const nodeName = (key) => key.replace(/^([^/:]+):(?=\/)/, "/rmpa/$1");
export const keyOfNode = (name) => name.replace(/^\/rmpa\/([^/]+)(?=\/)/, "$1:");
export const NodeLink = ({ name, children }) =>
  html`<a class="mono" href=${href("node", keyOfNode(name))}>${children?.length ? children : nodeName(name)}</a>`;
export const NodeLinks = ({ names }) =>
  names.map((name, at) => html`${at > 0 && ", "}<${NodeLink} key=${name} name=${name} />`);
export const ModuleLink = ({ name }) => html`<a class="whole" href=${href("module", name)}>${name}</a>`;

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
    connection=${connection}
    what="why"
    args=${{ kind, name, ...(peer ? { peer } : {}) }}
    label="Why?"
    now=${now}
    show=${(value) => html`<${Diagnosis} value=${value} />`}
  />`;

// A switch between few choices.
export const Choice = ({ label, value, options, onChoose, disabled }) =>
  html`<div class="choice" role="radiogroup" aria-label=${label}>
    ${options.map(
      ([key, text]) =>
        html`<button
          type="button"
          role="radio"
          aria-checked=${String(key === value)}
          tabindex=${key === value ? 0 : -1}
          disabled=${disabled}
          key=${key}
          onClick=${() => onChoose(key)}
          onKeyDown=${(event) => {
            const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
            if (!step) return;
            event.preventDefault();
            const at = (options.findIndex(([each]) => each === key) + step + options.length) % options.length;
            event.currentTarget.parentNode.children[at].focus();
            onChoose(options[at][0]);
          }}
        >
          ${text}
        </button>`,
    )}
  </div>`;
