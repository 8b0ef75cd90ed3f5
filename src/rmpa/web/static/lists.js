// Lists: kept as they were left, filtered, sorted, their first entries drawn, and as tables.

import { html, memo, useEffect, useState } from "./markup.js";
import { count } from "./format.js";

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

// A heading says how its column is drawn: "#" as numbers, "~" muted, "^" never narrow.
const KINDS = { "#": "number", "~": "muted", "^": "ends" };
const text = (heading) => heading.replace(/^[#~^]/, "");

function Heading({ column, sort, onSort }) {
  const kind = KINDS[column[0]],
    down = sort?.column === column ? sort.down : undefined;
  const press = () => onSort({ column, down: down === undefined ? kind === "number" : !down });
  return html`<th
    scope="col"
    class=${kind === "number" ? kind : ""}
    aria-sort=${down === undefined ? undefined : down ? "descending" : "ascending"}
  >
    ${onSort
      ? html`<button type="button" class="field sort" onClick=${press}>
          ${text(column)}<span aria-hidden="true">${down === undefined ? "" : down ? " ▼" : " ▲"}</span>
        </button>`
      : text(column) || html`<span class="unseen">Action</span>`}
  </th>`;
}

const Row = memo(
  ({ one, columns, tone, ...about }) =>
    html`<tr class=${tone}>
      ${columns.map(([heading, cell], at) =>
        at
          ? html`<td key=${heading} class=${KINDS[heading[0]] || ""}>${cell(one, about)}</td>`
          : html`<th key=${heading} scope="row">${cell(one, about)}</th>`,
      )}
    </tr>`,
);
const nameOf = (one, at) => (typeof one === "string" ? one : typeof one[0] === "string" ? one[0] : (one.name ?? at));

// Columns are [heading, what an entry of `list` has there, and by what it is sorted]; `about` goes to each of them.
export function Table({ caption, columns, list, about, tone, empty }) {
  const [sort, setSort] = useKept(`sort ${caption}`);
  const of = sort && columns.find(([heading]) => heading === sort.column)?.[2];
  const [first, more] = useFirst(of ? sorted(list, of, sort.down) : list, caption);
  if (!first.length) return html`<p class="empty">${empty || "Nothing here."}</p>`;
  return html`<div class="scroll" tabindex="0" role="region" aria-label=${caption}>
    <table>
      <caption class="unseen">
        ${caption}
      </caption>
      <thead>
        <tr>
          ${columns.map(
            ([column, , key]) => html`<${Heading} key=${column} ...${{ column, sort }} onSort=${key && setSort} />`,
          )}
        </tr>
      </thead>
      <tbody>
        ${first.map(
          (one, at) => html`<${Row} key=${nameOf(one, at)} ...${{ ...about, one, columns, tone: tone?.(one) }} />`,
        )}
      </tbody>
    </table>
    ${more}
  </div>`;
}
