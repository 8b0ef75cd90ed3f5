// A live message as a tree. What is nested is folded; a covariance is a matrix; an array says its true length.

import { html, useState } from "./markup.js";
import { clock, count } from "./format.js";

const INLINE = 12; // elements of an array that stand in one line
const OPEN = 2; // levels that are open at first
const PREVIEW = 48; // characters of what is folded
const MATRICES = { 36: [/covariance$/, 6], 9: [/covariance$|^[KR]$/, 3], 12: [/^P$/, 4] }; // names, and columns

const isScalar = (value) => typeof value === "number" || typeof value === "boolean";
const isTime = (value) => value.secs !== undefined && value.nsecs !== undefined && Object.keys(value).length === 2;
const written = (value) =>
  typeof value === "number" && !Number.isInteger(value) ? value.toPrecision(6) : String(value);

// An array of a message: its elements, or the first ones of them, and its length.
function elements(value) {
  if (Array.isArray(value)) return { first: value, length: value.length };
  return typeof value["…"] === "number" ? { first: value.first, length: value["…"] } : null;
}

function preview(value) {
  const words = Object.entries(value).map(([key, each]) => {
    if (each === null || typeof each !== "object") return `${key} ${written(each)}`;
    return isTime(each) ? `${key} ${clock(each.secs)}` : key;
  });
  const said = words.join(" · ");
  return said.length > PREVIEW ? `${said.slice(0, PREVIEW)}…` : said;
}

// What is folded is not drawn.
function Fold({ name, about, first, draw }) {
  const [open, setOpen] = useState(first);
  return html`<details open=${open} onToggle=${(event) => setOpen(event.currentTarget.open)}>
    <summary><span class="key">${name}</span>${!(open && first) && html` <span class="muted">${about}</span>`}</summary>
    ${open && draw()}
  </details>`;
}

const Plotted = ({ on, path, onClick, children }) =>
  html`<button type="button" class="field" aria-pressed=${String(on)} title=${`Plot ${path}`} onClick=${onClick}>
    ${on ? "● " : ""}${children}
  </button>`;
const Leaf = ({ value, path, text, plots }) =>
  isScalar(value) || text !== undefined
    ? html`<${Plotted} on=${plots.chosen.includes(path)} path=${path} onClick=${() => plots.choose(path)}
        >${text ?? written(value)}<//
      >`
    : html`<span>${typeof value === "string" ? JSON.stringify(value) : String(value)}</span>`;

const Line = ({ values, path, plots, length }) =>
  html`<span class="line"
    >${values.map(
      ([key, value]) =>
        html`<span key=${key}
          ><span class="key">${key}</span> <${Leaf} ...${{ value, plots }} path=${`${path}.${key}`}
        /></span>`,
    )}${length > values.length && html`<span class="muted">… ${count(length - values.length)} more</span>`}</span
  >`;

const Matrix = ({ values, columns, path, plots }) =>
  html`<table class="matrix">
    <tbody>
      ${Array.from(
        { length: values.length / columns },
        (_, row) =>
          html`<tr key=${row}>
            ${values.slice(row * columns, (row + 1) * columns).map((value, at) => {
              const index = row * columns + at;
              const text = typeof value === "number" ? String(Number(value.toPrecision(3))) : undefined;
              return html`<td key=${at}>
                <${Leaf} value=${value} text=${text} path=${`${path}.${index}`} plots=${plots} />
              </td>`;
            })}
          </tr>`,
      )}
    </tbody>
  </table>`;

function Row({ name, value, path, depth, plots }) {
  const key = html`<span class="key">${name}</span>`;
  if (value === null || typeof value !== "object")
    return html`<li>${key} <${Leaf} value=${value} path=${path} plots=${plots} /></li>`;
  const array = elements(value);
  if (array) return html`<li><${Elements} ...${{ name, array, path, depth, plots }} /></li>`;
  if (isTime(value)) {
    const text = `${value.secs}.${String(value.nsecs).padStart(9, "0")}`;
    const seen = value.secs > 1e8 && html` <span class="muted">${clock(value.secs)}</span>`;
    return html`<li>${key} <${Leaf} text=${text} path=${path} plots=${plots} />${seen}</li>`;
  }
  const inner = Object.entries(value);
  if (inner.length <= 4 && inner.every(([, each]) => isScalar(each)))
    return html`<li>${key} <${Line} values=${inner} path=${path} plots=${plots} /></li>`;
  const draw = () => html`<${Rows} rows=${inner} path=${path} depth=${depth + 1} plots=${plots} />`;
  const first = depth < OPEN && name !== "header";
  return html`<li><${Fold} name=${name} about=${preview(value)} first=${first} draw=${draw} /></li>`;
}

function Elements({ name, array, path, depth, plots }) {
  const { first, length } = array;
  const [named, columns] = MATRICES[length] || [];
  const flat = first.every((each) => each === null || typeof each !== "object");
  const about = length === 1 ? "1 element" : `${count(length)} elements`;
  if (!length) return html`<span class="key">${name}</span> <span class="muted">no elements</span>`;
  if (flat && named?.test(name) && first.length === length) {
    const draw = () => html`<${Matrix} values=${first} columns=${columns} path=${path} plots=${plots} />`;
    const zero = first.every((each) => each === 0);
    const said = `${length / columns} × ${columns}${zero ? ", all zero" : ""}`;
    return html`<${Fold} name=${name} about=${said} first=${!zero} draw=${draw} />`;
  }
  const rows = first.map((each, at) => [String(at), each]);
  if (flat) {
    const draw = () => html`<${Line} values=${rows} path=${path} plots=${plots} length=${length} />`;
    if (length <= INLINE) return html`<span class="key">${name}</span> ${draw()}`;
    return html`<${Fold} name=${name} about=${about} first=${false} draw=${draw} />`;
  }
  const draw = () => html`<${Rows} rows=${rows} path=${path} depth=${depth + 1} plots=${plots} length=${length} />`;
  return html`<${Fold} name=${name} about=${about} first=${depth < OPEN && length <= INLINE} draw=${draw} />`;
}

const Rows = ({ rows, path, depth, plots, length }) =>
  html`<ul>
    ${rows.map(
      ([key, value]) =>
        html`<${Row} key=${key} name=${key} ...${{ value, depth, plots }} path=${path ? `${path}.${key}` : key} />`,
    )}${length > rows.length && html`<li class="muted">… ${count(length - rows.length)} more</li>`}
  </ul>`;

// `chosen` are the paths of the numbers that are plotted; `onChoose` is called with the path of one that is pressed.
export const MessageTree = ({ value, chosen, onChoose }) =>
  html`<div class="tree">
    <${Rows} rows=${Object.entries(value)} path="" depth=${0} plots=${{ chosen, choose: onChoose }} />
  </div>`;
