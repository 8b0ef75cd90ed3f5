// The parameters of this module's core, or of a peer's, as a tree; each value can be changed.

import { html, useEffect, useRef, useState } from "../markup.js";
import { entries, section } from "../state.js";
import { Choice, Failure, Page, Panel, Text } from "../parts.js";
import { useFilter, useFirst, useKept } from "../lists.js";
import { Editable, useAgain } from "../asking.js";
import { plain } from "../format.js";
import { another, fresh, kind } from "../typed.js";

// Parameters as one tree: a namespace is an object.
export function grow(values) {
  const root = Object.create(null);
  for (const [name, value] of Object.entries(values)) {
    const steps = name.split("/").filter(Boolean);
    let at = root;
    for (const step of steps.slice(0, -1)) at = isTree(at[step]) ? at[step] : (at[step] = Object.create(null));
    at[steps[steps.length - 1]] = value;
  }
  return root;
}

// Seconds after which a peer's parameters are read again; this module's core tells its changes.
const PEER_PERIOD = 3;

export function Params({ name, state, connection }) {
  const own = section(state, "agent").name;
  const [module, setModule] = useKept("module", own);
  const [values, setValues] = useState(null);
  const [failure, setFailure] = useState(null);
  const filter = useFilter("name", name);
  const shown = useRef({});
  const peer = module === own ? "" : module;
  const take = (answer) => {
    if (shown.current.peer !== peer) return; // another module has been chosen meanwhile
    shown.current.digest = answer.digest;
    if (answer.values) setValues(answer.values);
    setFailure(null);
  };
  const open = connection.phase === "open";
  const ask = (what, args = {}) =>
    connection.ask(what, { peer, ...args }).then((answer) => {
      take(answer);
      return answer;
    });
  const read = (args) => ask("params", args).catch(setFailure);
  useEffect(() => {
    shown.current = { peer };
    setValues(null);
  }, [module]);
  // What was read stays while there is no connection.
  useAgain(open, peer ? PEER_PERIOD : 0, module, () => read(shown.current.digest && { has: shown.current.digest }));
  // Changes by others: this module's core tells them, a peer is asked while the page is seen.
  useEffect(() => {
    if (open && !peer && shown.current.digest) read({ has: shown.current.digest });
  }, [state.parameters]);
  const choices = entries(state, "modules")
    .filter(([, one]) => one.state === "up" || one.state === "here")
    .map(([each]) => [each, each]);
  return html`<${Page} title="Parameters" kind=${`Of the core of ${module}`}>
    <div class="row filter-row">
      <${Choice} label="Module" value=${module} onChoose=${setModule} options=${choices} />
    </div>
    <${Failure} failure=${failure} />
    <${Panel}
      >${filter.field}
      ${values
        ? html`<div class="tree">
            <${Namespace}
              tree=${grow(values)}
              path=""
              text=${filter.typed}
              may=${connection.may("control")}
              ask=${ask}
            />
          </div>`
        : !failure && html`<p class="empty">Reading …</p>`}<//
    >
    ${connection.may("control") && html`<${Panel} title="Set a parameter"><${Setter} ask=${ask} /><//>`}<//
  >`;
}

const holds = (value, path, text) =>
  path.toLowerCase().includes(text) ||
  (isTree(value) && Object.entries(value).some(([key, inner]) => holds(inner, `${path}/${key}`, text)));
const isTree = (value) => value !== null && typeof value === "object" && !Array.isArray(value);

function Namespace({ tree, path, text, may, ask }) {
  const rows = Object.entries(tree)
    .filter(([key, value]) => holds(value, `${path}/${key}`, text))
    .sort(([a], [b]) => a.localeCompare(b));
  const [first, more] = useFirst(rows, path);
  if (!rows.length) return html`<p class="empty">No parameter matches.</p>`;
  return html`<ul>
      ${first.map(
        ([key, value]) =>
          html`<li key=${key}>
            ${isTree(value)
              ? html`<details open>
                  <summary><span class="key">${key}/</span></summary>
                  <${Namespace} tree=${value} path=${`${path}/${key}`} text=${text} may=${may} ask=${ask} />
                </details>`
              : html`<${Leaf} name=${`${path}/${key}`} short=${key} value=${value} may=${may} ask=${ask} />`}
          </li>`,
      )}
    </ul>
    ${more}`;
}

function Leaf({ name, short, value, may, ask }) {
  const [sure, setSure] = useState(false);
  const [failure, setFailure] = useState(null);
  const written = plain(JSON.stringify(value)); // a code in JSON is the same text
  const save = (draft) => {
    const typed = another(draft, value);
    if (typed.error) return Promise.resolve({ failure: typed });
    return ask("set_param", { name, value: typed.value }).then(
      () => ({}),
      (refused) => ({ failure: refused }),
    );
  };
  const remove = () => (sure ? ask("delete_param", { name }).catch(setFailure) : setSure(true));
  if (!may) return html`<span class="key">${short}:</span> ${written}`;
  return html`<span class="key">${short}:</span>${" "}<${Editable}
      label=${name}
      shown=${written}
      begin=${written}
      save=${save}
    >
      <button type="button" onClick=${remove}>${sure ? "Yes, delete it" : "Delete"}</button
      ><${Failure} failure=${failure}
    /><//>`;
}

function Setter({ ask }) {
  const [name, setName] = useState("/");
  const [text, setText] = useState("");
  const [state, set] = useState({});
  const typed = fresh(text);
  const save = (event) => {
    event.preventDefault();
    if (typed.error) return set({ failure: typed });
    const said = `${name} is the ${kind(typed.value)} ${JSON.stringify(typed.value)}`;
    ask("set_param", { name, value: typed.value }).then(
      () => set({ said }),
      (failure) => set({ failure }),
    );
  };
  const edit = (take) => (value) => {
    take(value);
    set({});
  };
  return html`<form class="row" onSubmit=${save}>
    <${Text} label="Name" class="mono" value=${name} onInput=${edit(setName)} />
    <${Text} label="Value: JSON, or text" class="mono" value=${text} onInput=${edit(setText)} />
    <button class="primary">Set</button>
    <p role="status" class="muted said">
      ${state.said || (text && !typed.error && `It is sent as a ${kind(typed.value)}.`)}
    </p>
    <${Failure} failure=${state.failure} />
  </form>`;
}
