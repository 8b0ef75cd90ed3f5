// Search over all that has a name, and the list of keys.

import { useEffect, useLayoutEffect, useRef, useState, html } from "./markup.js";
import { entries } from "./state.js";
import { nodeName, href } from "./links.js";

const MOST = 40;
const KINDS = [
  ["modules", "module", "module"],
  ["topics", "topic", "topic"],
  ["services", "service", "service"],
  ["nodes", "node", "node"],
  ["resources", "resource", "resource"],
];

export function find(state, text, parameters = []) {
  const words = text.toLowerCase().split(/\s+/).filter(Boolean);
  const found = [];
  for (const [part, kind, page] of KINDS)
    for (const [name, value] of entries(state, part)) {
      const called = kind === "resource" ? "smart resource" : kind;
      const shown = kind === "node" ? nodeName(name) : name;
      const parts = [called, name, shown, value.type, value.module, value.description];
      const about = parts.filter(Boolean).join(" ").toLowerCase();
      if (!words.every((word) => about.includes(word))) continue;
      const last = words[words.length - 1] || "";
      const rank =
        name.toLowerCase() === last
          ? 0
          : name
                .toLowerCase()
                .split("/")
                .some((step) => step.startsWith(last))
            ? 1
            : 2;
      found.push({
        kind,
        name: shown,
        to: href(page, name),
        about: value.type || value.description || value.state || (kind === "node" && value.module) || "",
        rank,
      });
    }
  if (words.length)
    // of many hundred parameters none is meant before a word is typed
    for (const name of parameters) {
      if (!words.every((word) => `parameter ${name}`.toLowerCase().includes(word))) continue;
      const last = words[words.length - 1];
      found.push({
        kind: "parameter",
        name,
        to: href("params", name),
        about: "",
        rank: name
          .toLowerCase()
          .split("/")
          .some((step) => step.startsWith(last))
          ? 1
          : 2,
      });
    }
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
