// The parameters of this module's core, or of a peer's, as a tree; each value can be changed.

import { html, useEffect, useRef, useState } from "../vendor/htm-preact.js";
import { entries, section } from "../state.js";
import { Choice, Failure, Page, Panel } from "../parts.js";

// Parameters as one tree: a namespace is an object.
export function grow(values) {
  const root = Object.create(null);
  for (const [name, value] of Object.entries(values)) {
    const steps = name.split("/").filter(Boolean);
    let at = root;
    for (const step of steps.slice(0, -1)) at = at[step] && typeof at[step] === "object" && !Array.isArray(at[step]) ? at[step] : (at[step] = Object.create(null));
    at[steps[steps.length - 1]] = value;
  }
  return root;
}

const PEER_PERIOD = 3000; // milliseconds after which a peer's parameters are read again; this module's core tells its changes

export function Params({ name, state, connection }) {
  const own = section(state, "agent").name;
  const [module, setModule] = useState(own);
  const [values, setValues] = useState(null);
  const [failure, setFailure] = useState(null);
  const [text, setText] = useState(name || "");
  const shown = useRef({});
  const peer = module === own ? "" : module;
  const take = (answer) => {
    if (shown.current.peer !== peer) return; // another module has been chosen meanwhile
    shown.current.digest = answer.digest;
    if (answer.values) setValues(answer.values);
    setFailure(null);
  };
  const ask = (what, args = {}) => connection.ask(what, { peer, ...args }).then((answer) => { take(answer); return true; }, (failure) => { setFailure(failure); return false; });
  useEffect(() => { shown.current = { peer }; setValues(null); ask("params"); }, [module, connection.phase]);
  // Changes by others: this module's core tells them, a peer is asked while the page is seen.
  useEffect(() => { if (!peer && shown.current.digest) ask("params", { has: shown.current.digest }); }, [state.parameters]);
  useEffect(() => {
    if (!peer) return undefined;
    const timer = setInterval(() => document.hidden || !shown.current.digest || ask("params", { has: shown.current.digest }), PEER_PERIOD);
    return () => clearInterval(timer);
  }, [module, connection.phase]);
  const choices = entries(state, "modules").filter(([, one]) => one.state === "up" || one.state === "here").map(([name]) => [name, name]);
  return html`<${Page} title="Parameters" kind=${`Of the core of ${module}`}>
    <div class="row filter-row"><${Choice} label="Module" value=${module} onChoose=${setModule} options=${choices} /></div>
    <${Failure} failure=${failure} />
    <${Panel}><input class="filter" type="search" placeholder="Filter by name" aria-label="Filter by name" value=${text} onInput=${(event) => setText(event.target.value)} />
      ${values ? html`<div class="tree"><${Namespace} tree=${grow(values)} path="" text=${text.toLowerCase()} may=${connection.may("param")} ask=${ask} /></div>` : !failure && html`<p class="empty">Reading …</p>`}<//>
    ${connection.may("param") && html`<${Panel} title="Set a parameter"><${Setter} ask=${ask} /><//>`}<//>`;
}

const holds = (value, path, text) => path.toLowerCase().includes(text) || (isTree(value) && Object.entries(value).some(([key, inner]) => holds(inner, `${path}/${key}`, text)));
const isTree = (value) => value !== null && typeof value === "object" && !Array.isArray(value);

function Namespace({ tree, path, text, may, ask }) {
  const rows = Object.entries(tree).filter(([key, value]) => holds(value, `${path}/${key}`, text)).sort(([a], [b]) => a.localeCompare(b));
  if (!rows.length) return html`<p class="empty">No parameter is like that.</p>`;
  return html`<ul>${rows.map(([key, value]) => html`<li key=${key}>${isTree(value)
    ? html`<details open><summary><span class="key">${key}/</span></summary><${Namespace} tree=${value} path=${`${path}/${key}`} text=${text} may=${may} ask=${ask} /></details>`
    : html`<${Leaf} name=${`${path}/${key}`} short=${key} value=${value} may=${may} ask=${ask} />`}</li>`)}</ul>`;
}

function Leaf({ name, short, value, may, ask }) {
  const [draft, setDraft] = useState(null);
  const [sure, setSure] = useState(false);
  const written = JSON.stringify(value);
  const save = (event) => { event.preventDefault(); ask("set_param", { name, value: parse(draft) }).then((done) => done && setDraft(null)); };
  if (draft === null)
    return html`<span class="key">${short}:</span> ${may ? html`<button type="button" class="field" aria-label=${`Change ${name}, now ${written}`} onClick=${() => setDraft(written)}>${written}</button>` : written}`;
  return html`<form class="row" onSubmit=${save}><label><span>${name}</span><input autofocus value=${draft} onInput=${(event) => setDraft(event.target.value)} onKeyDown=${(event) => event.key === "Escape" && setDraft(null)} /></label>
    <button class="primary">Set</button><button type="button" onClick=${() => { setDraft(null); setSure(false); }}>Leave</button><button type="button" onClick=${() => (sure ? ask("delete_param", { name }) : setSure(true))}>${sure ? "Really delete it" : "Delete"}</button></form>`;
}

// JSON where it is some, else the text itself.
export function parse(text) { try { return JSON.parse(text); } catch { return text; } }

function Setter({ ask }) {
  const [name, setName] = useState("/");
  const [value, setValue] = useState("");
  return html`<form class="row" onSubmit=${(event) => { event.preventDefault(); ask("set_param", { name, value: parse(value) }); }}>
    <label>Name<input class="mono" value=${name} onInput=${(event) => setName(event.target.value)} /></label><label>Value: JSON, or text<input class="mono" value=${value} onInput=${(event) => setValue(event.target.value)} /></label><button class="primary">Set</button></form>`;
}
