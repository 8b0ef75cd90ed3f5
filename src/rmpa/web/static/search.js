// Search over all that has a name, and the list of keys.

import { html, useEffect, useLayoutEffect, useRef, useState } from "./markup.js";
import { entries } from "./state.js";
import { href, nodeName } from "./links.js";

const MOST = 40;
const KINDS = [
  ["modules", "module"],
  ["topics", "topic"],
  ["services", "service"],
  ["nodes", "node"],
  ["resources", "resource"],
];

export function find(state, text, parameters = []) {
  const words = text.toLowerCase().split(/\s+/).filter(Boolean);
  const last = words.at(-1) || "";
  const found = [];
  const look = (kind, page, name, shown, said, about) => {
    const lower = name.toLowerCase();
    if (!words.every((word) => said.filter(Boolean).join(" ").toLowerCase().includes(word))) return;
    const rank = lower === last ? 0 : lower.split("/").some((step) => step.startsWith(last)) ? 1 : 2;
    found.push({ kind, name: shown, to: href(page, name), about, rank });
  };
  for (const [part, kind] of KINDS)
    for (const [name, value] of entries(state, part)) {
      const called = kind === "resource" ? "smart resource" : kind;
      const shown = kind === "node" ? nodeName(name) : name;
      const about = value.type || value.description || value.state || (kind === "node" && value.module) || "";
      look(kind, kind, name, shown, [called, name, shown, value.type, value.module, value.description], about);
    }
  // Of many hundred parameters none is meant before a word is typed.
  if (words.length) for (const name of parameters) look("parameter", "params", name, name, ["parameter", name], "");
  return found
    .sort((a, b) => a.rank - b.rank || a.name.length - b.name.length || a.name.localeCompare(b.name))
    .slice(0, MOST);
}

function Dialog({ label, onClose, children }) {
  const dialog = useRef();
  useLayoutEffect(() => {
    const shown = dialog.current;
    shown.showModal();
    return () => shown.close(); // gives the focus back: while it is shown, nothing else takes it
  }, []);
  return html`<dialog
    ref=${dialog}
    aria-label=${label}
    onClose=${onClose}
    onClick=${(event) => event.target === dialog.current && onClose()}
  >
    ${children}
  </dialog>`;
}

export function Search({ state, connection, onClose }) {
  const [parameters, setParameters] = useState([]);
  useEffect(() => {
    if (connection.may("view"))
      connection.ask("param_names").then(
        (value) => setParameters(value.names),
        () => {},
      );
  }, []);
  const [text, setText] = useState("");
  const [at, setAt] = useState(0);
  const found = find(state, text, parameters);
  const chosen = Math.min(at, found.length - 1);
  useEffect(() => document.getElementById(`found-${chosen}`)?.scrollIntoView({ block: "nearest" }), [chosen]);
  const go = (one) => {
    if (one) {
      location.hash = one.to;
      onClose();
    }
  };
  const key = (event) => {
    const by = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (by) {
      event.preventDefault();
      setAt(Math.max(0, Math.min(found.length - 1, chosen + by)));
    }
    if (event.key === "Enter") {
      event.preventDefault();
      go(found[chosen]);
    }
  };
  return html`<${Dialog} label="Search" onClose=${onClose}>
    <input
      type="search"
      role="combobox"
      aria-expanded="true"
      aria-controls="found"
      aria-label="Name of a module, topic, service, node, resource or parameter"
      aria-activedescendant=${found.length ? `found-${chosen}` : undefined}
      placeholder="Module, topic, node, parameter …"
      autofocus
      value=${text}
      onInput=${(event) => {
        setText(event.target.value);
        setAt(0);
      }}
      onKeyDown=${key}
    />
    <ul id="found" class="found" role="listbox" aria-label="Found">
      ${found.map(
        (one, index) =>
          html`<li
            key=${one.kind + one.name}
            id=${`found-${index}`}
            role="option"
            aria-selected=${String(index === chosen)}
            onClick=${() => go(one)}
          >
            <span class="kind">${one.kind}</span><span class="what">${one.name}</span
            ><span class="muted">${one.about}</span>
          </li>`,
      )}
    </ul>
    ${!found.length && html`<p class="empty">Nothing has that name.</p>`}<//
  >`;
}

export function Shortcuts({ pages, onClose }) {
  const keys = [
    ["/", "Search"],
    ...pages.map(([, title, key]) => [`g ${key}`, title]),
    ["w", "Why? on the page of a topic, service or module"],
    ["c", "Dark or light colours"],
    ["← →", "Around the ring"],
    ["?", "These keys"],
    ["Esc", "Close"],
  ];
  return html`<${Dialog} label="Keys" onClose=${onClose}
    ><h2>Keys</h2>
    <dl class="keys">
      ${keys.map(
        ([key, text]) =>
          html`<div key=${key}>
            <dt>${key.split(" ").map((each) => html`<kbd>${each}</kbd> `)}</dt>
            <dd>${text}</dd>
          </div>`,
      )}
    </dl>
    <button type="button" onClick=${onClose}>Close</button><//
  >`;
}
