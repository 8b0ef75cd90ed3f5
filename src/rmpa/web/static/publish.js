// A form for a message of any type, made from its definition, and what publishes it: once, or at a rate.

import { html, useEffect, useRef, useState } from "./markup.js";
import { count } from "./format.js";
import { section } from "./state.js";
import { Failure, Mark, Panel, Pick, Text } from "./parts.js";
import { Question } from "./asking.js";
import { number, primitive } from "./typed.js";

const FASTEST = 50; // messages a second
const MOST_ITEMS = 64; // messages in an array of the form
const HEADER = "std_msgs/Header";
const PRIMITIVE = /^(bool|byte|char|string|time|duration|u?int(8|16|32|64)|float(32|64))$/;
const DEFAULTS = { string: "", time: "now", bool: "false" };

// What stands in the form at first: texts, objects of them, and lists.
function blank(types, [, type, size]) {
  const one = PRIMITIVE.test(type) ? (DEFAULTS[type] ?? "0") : null;
  if (size === null) return one ?? draft(types, type);
  if (one !== null) {
    const all = Array.from({ length: Math.max(0, size) }, () => one);
    return type === "string" ? JSON.stringify(all) : all.join(", ");
  }
  return Array.from({ length: Math.max(0, size) }, () => draft(types, type));
}
// The seq of a header is counted by the server.
const fieldsOf = (types, type) => types[type].filter(([name]) => type !== HEADER || name !== "seq");
const draft = (types, type) => {
  const made = Object.fromEntries(fieldsOf(types, type).map((field) => [field[0], blank(types, field)]));
  return type === "geometry_msgs/Quaternion" ? { ...made, w: "1" } : made; // one that turns nothing
};

// The message that is meant; what is wrong goes into `errors` by path.
function meant(types, type, size, text, path, errors) {
  const one = (each, at) => {
    const { value, error } = primitive(type, each);
    if (error) errors[path] ??= at === undefined ? error : `Element ${at}: ${error}`;
    return value;
  };
  if (PRIMITIVE.test(type) && size === null) return one(text);
  if (PRIMITIVE.test(type)) {
    const parts = type === "string" ? strings(text) : text.trim() ? text.split(",") : [];
    if (!parts) errors[path] = 'Write texts as ["one", "two"].';
    else if (size >= 0 && parts.length !== size) errors[path] = `It has ${size} elements, not ${parts.length}.`;
    return (parts || []).map(one);
  }
  if (size !== null) return text.map((each, at) => meant(types, type, null, each, `${path}[${at}]`, errors));
  return Object.fromEntries(
    fieldsOf(types, type).map(([name, inner, length]) => [
      name,
      meant(types, inner, length, text[name], path ? `${path}.${name}` : name, errors),
    ]),
  );
}

function strings(text) {
  try {
    const made = JSON.parse(text.trim() || "[]");
    return Array.isArray(made) && made.every((each) => typeof each === "string") ? made : null;
  } catch {
    return null;
  }
}

export function PublishPanel({ connection, state, topic, type }) {
  const known = type && type !== "*";
  const [typed, setTyped] = useState("std_msgs/String");
  const name = known ? type : typed;
  return html`<${Panel} title="Publish" wide
    >${!known &&
    html`<${Text}
      look="filter"
      label="Type, which no node says"
      class="mono"
      value=${typed}
      onInput=${(text) => setTyped(text.trim())}
    />`}
    <${Question}
      connection=${connection}
      what="message"
      args=${{ type: name }}
      label="Fill in a message"
      show=${(about) =>
        html`<${Form} key=${about.type} connection=${connection} state=${state} topic=${topic} about=${about} />`}
  /><//>`;
}

function Form({ connection, state, topic, about }) {
  const { types, type } = about;
  const [values, setValues] = useState(() => draft(types, type));
  const [errors, setErrors] = useState({});
  const [rate, setRate] = useState("1");
  const [said, say] = useState({});
  const form = useRef(),
    end = useRef(() => {});
  const allowed = connection.may("control");
  const running = said.running && !said.failure;
  useEffect(() => () => end.current(), []);
  useEffect(() => {
    const wrong = form.current.querySelector("[aria-invalid=true]");
    for (let at = wrong; at; at = at.parentNode.closest?.("details")) if (at.tagName === "DETAILS") at.open = true;
    wrong?.focus();
  }, [errors]);
  const told = (message) => {
    if (message.op === "published") return say((before) => ({ ...before, n: message.n }));
    end.current();
    if (message.field) setErrors({ [message.field]: message.error.slice(message.field.length + 2) });
    say((before) => ({ ...before, failure: message, running: false }));
  };
  const publish = (often) => {
    const wrong = {};
    const made = meant(types, type, null, values, "", wrong);
    const speed = often ? number(rate) : { value: 0 };
    if (!speed.error && often && !(speed.value > 0 && speed.value <= FASTEST))
      speed.error = `Type a rate up to ${FASTEST} Hz.`;
    if (speed.error) wrong["?rate"] = speed.error;
    setErrors(wrong);
    if (Object.keys(wrong).length) return say({ failure: { error: "Nothing was published: see the fields." } });
    end.current();
    say({ running: often, n: 0 });
    end.current = connection.publish({ topic, type, values: made, rate: speed.value }, told);
  };
  const stop = () => {
    end.current();
    say((before) => ({ ...before, running: false }));
  };
  const to = section(state, "topics")[topic]?.to || [];
  const drawn = { types, errors, disabled: !allowed };
  return html`<form class="form" ref=${form} onSubmit=${(event) => (event.preventDefault(), publish(false))}>
    <${Struct} ...${drawn} type=${type} path="" value=${values} change=${setValues} depth=${0} />
    <details>
      <summary>${type}</summary>
      <pre class="tree" tabindex="0">${about.text}</pre>
    </details>
    <div class="row">
      <button class="primary" disabled=${!allowed}>Publish once</button>
      ${running
        ? html`<button type="button" onClick=${stop}>Stop</button>`
        : html`<button type="button" disabled=${!allowed} onClick=${() => publish(true)}>Publish at a rate</button>`}
      <${Entry} ...${drawn} label="Rate in Hz" path="?rate" value=${rate} change=${setRate} />
      ${!allowed && html`<span class="muted">This page is read-only: start rmpa web with --control.</span>`}
    </div>
    <div aria-live="polite">
      <${Failure} failure=${said.failure} />
      ${said.n > 0 &&
      html`<p>
        <${Mark} state="OK" word=${`Published ${said.n === 1 ? "once" : `${count(said.n)} times`}`} />
        <span class="muted">
          ${running && " · goes on until this page leaves or is hidden"} ·
          ${to.length ? ` subscribed in ${to.join(", ")}` : " no node subscribes to it here"}</span
        >
      </p>`}
    </div>
  </form>`;
}

function Struct({ types, type, path, value, change, depth, ...more }) {
  const fields = fieldsOf(types, type);
  if (!fields.length) return html`<p class="muted">It has no fields.</p>`;
  const set = (name) => (next) => change({ ...value, [name]: next });
  return html`<div class="fields">
    ${fields.map(([name, inner, size]) => {
      const about = { ...more, types, key: name, path: path ? `${path}.${name}` : name, value: value[name] };
      const label = `${name} ${inner}${size === null ? "" : size < 0 ? "[]" : `[${size}]`}`;
      if (PRIMITIVE.test(inner)) {
        const hint = size === null ? undefined : inner === "string" ? '["one", "two"]' : "1, 2, 3";
        return html`<${Entry}
          ...${about}
          ...${{ label, hint, kind: size === null ? inner : "" }}
          change=${set(name)}
        />`;
      }
      const draw = size === null ? Struct : Items;
      return html`<details key=${name} class="wide" open=${depth < 2 && name !== "header"}>
        <summary>${label}</summary>
        <${draw} ...${about} type=${inner} size=${size} change=${set(name)} depth=${depth + 1} />
      </details>`;
    })}
  </div>`;
}

function Items({ types, type, path, value, change, size, ...more }) {
  const add = () => change([...value, draft(types, type)]);
  const set = (at) => (next) => change(value.map((each, index) => (index === at ? next : each)));
  return html`<div class="form">
    ${value.map(
      (each, at) =>
        html`<div key=${at} class="item">
          <p class="row">
            <span class="mono">[${at}]</span>${size < 0 &&
            html`<button type="button" onClick=${() => change(value.filter((_, index) => index !== at))}>
              Remove [${at}]
            </button>`}
          </p>
          <${Struct} ...${{ ...more, types, type }} path=${`${path}[${at}]`} value=${each} change=${set(at)} />
        </div>`,
    )}
    ${size < 0 &&
    html`<p>
      <button type="button" disabled=${more.disabled || value.length >= MOST_ITEMS} onClick=${add}>
        Add to ${path}
      </button>
    </p>`}
  </div>`;
}

function Entry({ label, path, value, change, errors, disabled, kind, hint }) {
  const error = errors[path] ?? errors[Object.keys(errors).find((each) => each.startsWith(`${path}[`))];
  const about = {
    value,
    disabled,
    "aria-invalid": error ? "true" : undefined,
    "aria-describedby": error ? `wrong-${path}` : undefined,
  };
  const typed = (event) => change(event.target.value);
  return html`<div class=${hint ? "wide" : ""}>
    <label
      ><span class="mono">${label}</span>${kind === "bool"
        ? html`<${Pick} ...${about} names=${["false", "true"]} onChange=${change} />`
        : html`<input class="mono" placeholder=${hint} spellcheck="false" ...${about} onInput=${typed} />`}</label
    >${error && html`<p class="wrong" id=${`wrong-${path}`}><${Mark} state="ERROR" word=${error} /></p>`}
  </div>`;
}
