// Small parts that all pages are made of.

import { createContext, html, useContext, useEffect, useRef, useState } from "./markup.js";
import { ago, plain } from "./format.js";

const stroke = (d) => html`<path class="stroke" d=${d} />`;
const heavy = (d) => html`<path class="stroke heavy" d=${d} />`;
const fill = (d) => html`<path class="fill" d=${d} />`;
const ring = (dashes, r = 6) => html`<circle class="stroke" cx="8" cy="8" r=${r} stroke-dasharray=${dashes} />`;
const disc = (r) => html`<circle class="fill" cx="8" cy="8" r=${r} />`;

// Each state and level has a word, a colour (by its class) and a shape: none of them is needed to tell them apart.
const STATES = {
  here: ["this module", "accent", () => fill("M8 1.5 14.5 8 8 14.5 1.5 8Z")],
  up: ["up", "good", () => disc(5.5)],
  silent: ["silent", "warn", () => ring("3.4 2.4", 5.5)],
  linking: ["no link", "warn", () => [ring(undefined, 5.5), fill("M8 2.5a5.5 5.5 0 0 1 0 11Z")]],
  refused: ["refused", "bad", () => heavy("M3 3l10 10M13 3 3 13")],
  relayed: ["relayed", "good", () => [ring(), disc(3)]],
  away: ["away", "idle", () => stroke("M8 2 14 8 8 14 2 8Z")],
  lost: ["link lost", "bad", () => heavy("M1.5 8H6M10 8h4.5M6 4.5v7M10 4.5v7")],
  pending: ["pending", "warn", () => [ring("2.4 2.3"), stroke("M8 5v6M5 8h6")]],
  revoked: ["revoked", "bad", () => [ring(), stroke("M4 12 12 4")]],
  foreign: ["foreign", "idle", () => stroke("M3 3h10v10H3Z")],
  OK: ["OK", "good", () => heavy("M2.5 8.5 6.5 12.5 13.5 4")],
  WARN: ["warning", "warn", () => fill("M8 1.5 15 14H1Z")],
  ERROR: ["error", "bad", () => fill("M5 1.5h6L14.5 5v6L11 14.5H5L1.5 11V5Z")],
  STALE: ["stale", "idle", () => [ring(), stroke("M8 4.5V8l2.5 2")]],
  "": ["not known", "idle", () => stroke("M3 8h10")],
};
export const shape = (state) => (STATES[state] || STATES[""])[2]();
export function known(state) {
  const [word, tone] = STATES[state] || STATES[""];
  return { word, tone };
}

export function Mark({ state, word }) {
  const about = known(state);
  return html`<span class="mark ${about.tone}"
    ><svg viewBox="0 0 16 16" aria-hidden="true">${shape(state)}</svg>${word === undefined ? about.word : word}</span
  >`;
}

export function Facts({ rows }) {
  const shown = rows.filter(([, value]) => ![undefined, null, false, "", "–"].includes(value));
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

export const Panel = ({ title, children, aside, wide }) =>
  html`<section class=${wide ? "panel wide" : "panel"}>
    ${title &&
    html`<header>
      <h2>${title}</h2>
      ${aside}
    </header>`}${children}
  </section>`;

// What a cell of a table says, and what else below it.
export const under = (head, ...below) =>
  html`${head}${below.filter(Boolean).map((each, at) => html`<div key=${at} class="muted">${each}</div>`)}`;

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

// Draws anew so many times a second.
export function useTick(seconds) {
  const [, tick] = useState(0);
  useEffect(() => {
    const timer = setInterval(() => tick((n) => n + 1), seconds * 1000);
    return () => clearInterval(timer);
  }, [seconds]);
}

// A time that has passed; it counts by itself, once a second.
export function Since({ moment, text = (shown) => shown }) {
  useTick(1);
  return html`<time datetime=${new Date(moment * 1000).toISOString()}>${text(ago(moment))}</time>`;
}

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

export const IconButton = ({ label, title = label, press, look = "", children, ...more }) =>
  html`<button type="button" class="icon ${look}" aria-label=${label} title=${title} onClick=${press} ...${more}>
    ${children}
  </button>`;

// Fields of forms, each with its label.
export const Text = ({ label, look, onInput, ...more }) =>
  html`<label class=${look}>${label}<input ...${more} onInput=${(event) => onInput(event.target.value)} /></label>`;
export const Check = ({ label, onChange, ...more }) =>
  html`<label class="check"
    ><input type="checkbox" ...${more} onChange=${(event) => onChange(event.target.checked)} /><span
      >${label}</span
    ></label
  >`;
export const Pick = ({ names, onChange, ...more }) =>
  html`<select ...${more} onChange=${(event) => onChange(event.target.value)}>
    ${names
      .map((each) => [each].flat())
      .map(([value, text = value]) => html`<option key=${value} value=${value}>${text}</option>`)}
  </select>`;
// \`names\` are values, or of each its value and text.
export const Select = ({ label, look, ...more }) => html`<label class=${look}>${label}<${Pick} ...${more} /></label>`;
