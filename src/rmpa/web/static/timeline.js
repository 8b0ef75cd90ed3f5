// What a Smart Resource did in the last ten minutes: which profile ran when and why, and each quality that is asked
// for against its bound. The resource tells its last ten decisions; of all else a page knows what came while it was
// open.

import { html, useEffect, useState } from "./markup.js";
import { clock, duration, seconds } from "./format.js";
import { figure } from "./plot.js";
import { Mark, useTick } from "./parts.js";

const SPAN = 600; // seconds that are drawn
const KEPT = 600; // samples, and of decisions a tenth of it
const WIDE = 1000; // units of a drawing; its height is in pixels
const ROW = 26;
const TALL = 90;
const BETWEEN = "\x1f"; // the parts of a status' key, as in monitor/diagnostics.py

// A bound as the resource writes it: "at least 20 Hz", "at most 0.1 s", "exactly 3", "1 m to 2 m".
export function bound(wanted = "") {
  const [, way, text] = /^(at least|at most|exactly)? ?(.*)$/.exec(wanted);
  const [low, high = low] = text.split(" to ").map(Number.parseFloat);
  if (!Number.isFinite(low)) return null; // words
  return { low: way === "at most" ? -Infinity : low, high: way === "at least" ? Infinity : high };
}
const isShort = (value, { low, high }) => value < low || value > high;
const mapped = (object, of) => Object.fromEntries(Object.entries(object || {}).map(([key, each]) => [key, of(each)]));
const termsOf = (decision) => decision.scores?.find((each) => each.terms?.length)?.terms || [];

export const fresh = () => ({ changes: [], samples: [], scores: new Map(), health: undefined });

// What is new in what the resource says is added to its past.
export function record(past, { decision = {}, health, profile }, now) {
  const first = !past.changes.length;
  const seen = new Set(past.changes.map((each) => each.at));
  const told = (decision.history || []).filter((each) => !seen.has(each.at));
  past.changes.push(...told);
  past.changes.sort((a, b) => a.at - b.at);
  const last = past.changes.at(-1);
  // An earlier release tells no history.
  if (!decision.history && decision.scores && profile !== last?.to)
    past.changes.push({ at: now, from: last?.to ?? "", to: profile, why: "seen by this page" });
  if (past.changes.length > KEPT / 10) past.changes.splice(0, past.changes.length - KEPT / 10);
  // The scores of a decision are known where it was made while the page was open.
  if (!first && told.length) past.scores.set(past.changes.at(-1).at, decision.scores);
  if (health && health !== past.health) {
    const bounds = Object.fromEntries(termsOf(decision).map((each) => [each.attribute, each.wanted]));
    past.samples.push({ at: now, values: mapped(health.values, Number.parseFloat), bounds });
    if (past.samples.length > KEPT) past.samples.shift();
  }
  past.health = health;
  return past;
}

// The samples of `/diagnostics`, where the resource said the same before the page was open; `columns` as of "past".
// What was asked for then is not known: they are judged by what is asked now.
export function earlier(past, columns) {
  const { at: first = Infinity, bounds = {} } = past.samples[0] || {};
  const made = (columns[""] || []).map((at, row) => ({ at, values: mapped(columns, (column) => column[row]), bounds }));
  return past.samples.unshift(...made.filter((each) => each.at < first - 0.5));
}

const pasts = new Map(); // by resource, for as long as the page is open

export function usePast(connection, key, told, status) {
  if (!pasts.has(key)) pasts.set(key, fresh());
  const past = record(pasts.get(key), told, Date.now() / 1000);
  const [, draw] = useState();
  useEffect(() => {
    if (past.asked || !status) return;
    past.asked = true;
    const take = (columns) => draw(earlier(past, columns));
    connection.ask("past", { status: status.join(BETWEEN) }).then(take, () => {});
  }, [status?.join(BETWEEN)]);
  return past;
}

// Which profile ran from when to when, as far back as `from`.
export function spells(changes, from, now) {
  const before = changes[0]?.from ? [{ at: -Infinity, to: changes[0].from, why: "" }] : [];
  const all = [...before, ...changes.filter((each) => !each.failed)];
  return all
    .map((each, at) => ({ ...each, since: Math.max(each.at, from), until: all[at + 1]?.at ?? Math.max(now, each.at) }))
    .filter((each) => each.until > from);
}

const place = (at, from) => Number((((at - from) / SPAN) * WIDE).toFixed(1));
const names = (profile) => profile || "none";

function Strip({ past, profiles, from, now }) {
  const [picked, pick] = useState(null);
  const shown = spells(past.changes, from, now);
  const rows = [...new Set([...profiles, ...shown.map((each) => each.to)])];
  const spell = shown.find((each) => each.at === picked) ?? shown.at(-1);
  const point = (event) => {
    const box = event.currentTarget.getBoundingClientRect();
    const at = from + ((event.clientX - box.left) / box.width) * SPAN;
    pick(shown.findLast((each) => each.since <= at)?.at ?? null);
  };
  const said = (each) =>
    `${names(each.to)}${each.at > from ? ` from ${clock(each.at)}` : ""} for ${duration(each.until - each.since)}`;
  return html`<div class="trend strips">
      <div class="lanes">${rows.map((row) => html`<div key=${row}>${names(row)}</div>`)}</div>
      <svg
        class="spells"
        viewBox=${`0 0 ${WIDE} ${rows.length * ROW}`}
        preserveAspectRatio="none"
        role="img"
        aria-label=${`Profiles of the last ten minutes: ${shown.map(said).join("; ")}`}
        style=${{ height: `${rows.length * ROW}px` }}
        onPointerMove=${(event) => event.pointerType === "mouse" && point(event)}
        onPointerLeave=${(event) => event.pointerType === "mouse" && pick(null)}
        onClick=${point}
      >
        ${rows.map((row, at) => html`<path key=${row} class="base" d=${`M0 ${at * ROW + ROW - 0.5}H${WIDE}`} />`)}
        ${shown.map((each) => {
          const x = Math.max(0, place(each.since, from));
          return html`<rect
            key=${each.at}
            class=${each === spell ? "picked" : ""}
            x=${x}
            y=${rows.indexOf(each.to) * ROW + 4}
            width=${Math.max(2, place(each.until, from) - x)}
            height=${ROW - 8}
          />`;
        })}
      </svg>
    </div>
    <p role="status">
      ${spell ? html`<strong>${said(spell)}</strong> ${spell.why}${took(spell)}` : "Nothing ran yet."}
    </p>`;
}
const took = (each) => Number.isFinite(each.took) && ` (the change took ${seconds(each.took)})`;

// The windows of one quality: each with the bound of its time, and whether it fell short of it.
export const windows = (samples, name, from) =>
  samples
    .filter((each) => each.at > from && Number.isFinite(each.values[name]))
    .map(({ at, values: { [name]: value }, bounds: { [name]: wanted } }) => {
      const edge = bound(wanted);
      return { at, value, wanted, edge, short: edge !== null && isShort(value, edge) };
    });

// Windows that follow each other and have the same `key`, as one.
function runs(list, key, now) {
  const made = [];
  for (const each of list) {
    if (made.at(-1)?.[key] !== each[key]) made.push({ ...each });
    for (const one of made.slice(-2)) one.until = one === made.at(-1) ? now : made.at(-1).at;
  }
  return made;
}

// One quality: its line, the bound as it was at each moment, and below it where it fell short.
function Trend({ term, samples, unit, from, now }) {
  const { attribute: name } = term;
  const own = windows(samples, name, from);
  const last = bound(term.wanted);
  const bounds = runs(own, "wanted", now);
  const edges = ({ edge }) => (edge ? [edge.low, edge.high].filter(Number.isFinite) : []);
  const all = [...own.map((each) => each.value), ...[...bounds, { edge: last }].flatMap(edges)];
  const low = Math.min(0, ...all),
    most = Math.max(...all, low + 1e-9);
  const high = most + (most - low) / 4;
  const x = (at) => place(at, from);
  const y = (value) => ((1 - (value - low) / (high - low)) * TALL).toFixed(1);
  const line = own.map((each, at) => `${at ? "L" : "M"}${x(each.at)} ${y(each.value)}`).join("");
  const steps = bounds.flatMap((each) => edges(each).map((edge) => `M${x(each.at)} ${y(edge)}H${x(each.until)}`));
  const fell = runs(own, "short", now).filter((each) => each.short);
  const value = own.at(-1)?.value;
  const shown = value === undefined ? "not measured yet" : `${figure(value)}${unit ? `\u2009${unit}` : ""}`;
  const asked = term.wanted ? `wanted ${term.wanted}${term.hard ? ", hard" : ""}` : "asked for no more";
  const counted = (key) => own.filter((each) => each[key]).length;
  const said = `${counted("short")} of ${counted("edge")} windows fell short`;
  const state = value === undefined || !last ? "STALE" : isShort(value, last) ? "WARN" : "OK";
  return html`<div class="trend">
    <div>
      <strong>${name}</strong> ${shown}
      <div class="muted">${asked}</div>
      <${Mark} state=${state} word=${{ OK: "met", WARN: "falls short", STALE: "not judged" }[state]} />
      <div class="muted">${said}</div>
    </div>
    <div class="drawn">
      <span class="muted most">${Number(high.toPrecision(2))}</span>
      <svg
        viewBox=${`0 0 ${WIDE} ${TALL + 8}`}
        preserveAspectRatio="none"
        role="img"
        aria-label=${`${name}: ${shown}, ${asked}; ${said}`}
      >
        <path class="base" d=${`M0 ${TALL}H${WIDE}`} />
        ${fell.map(({ at, until }) => {
          const wide = Math.max(2, x(until) - x(at));
          return html`<rect key=${at} class="short" x=${x(at)} y=${TALL} width=${wide} height="8" />`;
        })}
        <path class="bound" d=${steps.join("")} />
        <path class="line" d=${line && `${line}H${x(now)}`} />
      </svg>
    </div>
  </div>`;
}

// What is asked for, and what was within the time that is drawn.
export function askedFor(past, decision, from) {
  const found = new Map();
  for (const { at, bounds } of past.samples)
    if (at > from) for (const attribute of Object.keys(bounds)) found.set(attribute, { attribute, wanted: "" });
  for (const term of termsOf(decision)) found.set(term.attribute, term);
  return [...found.values()];
}

export function Timeline({ past, decision, profiles, units }) {
  useTick(2);
  const now = Date.now() / 1000,
    from = now - SPAN;
  const terms = askedFor(past, decision, from);
  return html`<div class="timeline">
    <${Strip} ...${{ past, profiles, from, now }} />
    ${terms.map((term) => {
      const about = { term, from, now, samples: past.samples, unit: units[term.attribute] };
      return html`<${Trend} key=${term.attribute} ...${about} />`;
    })}
    <div class="trend">
      <div></div>
      <p class="axis muted"><span>10 min ago</span><span>5 min</span><span>now</span></p>
    </div>
    ${!terms.length && html`<p class="empty">No client and no context asks for a quality: none is judged.</p>`}
  </div>`;
}

// The last ten decisions, the newest first; `explain` draws the scores where they are known.
export function Decisions({ past, decision, explain }) {
  const last = past.changes.slice(-10).reverse();
  if (!last.length) return html`<p class="empty">No decision has been made yet.</p>`;
  return html`<ol class="decisions">
    ${last.map((each, at) => {
      const scores = at ? past.scores.get(each.at) : decision.scores;
      return html`<${Decision} key=${each.at} ...${{ each, scores, explain }} present=${!at} />`;
    })}
  </ol>`;
}

function Decision({ each, scores, explain, present }) {
  const [chosen, choose] = useState(null);
  const open = chosen ?? present;
  const press = (event) => {
    event.preventDefault(); // the attribute says what is open
    choose(!open);
  };
  const when = present ? "now" : `at ${clock(each.at)}`;
  return html`<li>
    <details open=${open}>
      <summary onClick=${press}>
        <time class="mono muted">${clock(each.at)}</time><strong>${names(each.from)} → ${names(each.to)}</strong
        ><span>${each.why}${each.failed && html` <${Mark} state="ERROR" word=${`failed: ${each.failed}`} />`}</span
        ><span class="muted">${Number.isFinite(each.took) && seconds(each.took)}</span>
      </summary>
      ${open &&
      (scores
        ? html`<p class="muted">The scores ${when}:</p>
            ${explain(scores, each.to, when)}`
        : html`<p class="empty">Its scores are not kept: this page was not open then.</p>`)}
    </details>
  </li>`;
}
