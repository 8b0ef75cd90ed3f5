// Modules that are heard and are not of this mesh: why, and the line or the button that lets one in.

import { html, useState } from "./markup.js";
import { useAsk } from "./asking.js";
import { entries } from "./state.js";
import { Failure, Mark, Panel, Since } from "./parts.js";

export function Outside({ state, connection }) {
  const list = entries(state, "outside");
  return (
    list.length > 0 &&
    html`<${Panel} title="Not in this mesh">
      <ul class="outside">
        ${list.map(([key, one]) => html`<${Knocking} key=${key} one=${one} connection=${connection} />`)}
      </ul><//
    >`
  );
}

function Knocking({ one, connection }) {
  const [state, ask] = useAsk(connection);
  const invite = () => ask("invite", { name: one.name });
  const [fact, ...remedy] = one.text.replace(`${one.state}: `, "").split("; ");
  const [before, after] = remedy.join("; ").split(one.invite || "\n");
  return html`<li>
    <p class="row">
      <strong>${one.name}</strong><${Mark} state=${one.state} /><code>${one.address}</code
      ><span class="muted"><${Since} moment=${one.since} /></span>
    </p>
    <p>${fact}.</p>
    ${before && html`<p class="muted">${before}${after && html`<code>${one.invite}</code>${after}`}.</p>`}
    ${one.here &&
    one.invite &&
    connection.may("control") &&
    html`<button type="button" onClick=${invite} disabled=${state.waits}>
      ${state.waits ? "Asking …" : `Invite ${one.name}${state.value ? " again" : ""}`}
    </button>`}
    <div aria-live="polite">
      <${Failure} failure=${state.failure} />${state.value && html`<${Token} name=${one.name} made=${state.value} />`}
    </div>
  </li>`;
}

// The token is kept in no place but this: it is gone with the page, or once the module has joined.
function Token({ name, made }) {
  const [copied, setCopied] = useState("");
  const until = new Date(made.until * 1000).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" });
  const copy = () =>
    navigator.clipboard.writeText(made.line).then(
      () => setCopied("Copied."),
      () => setCopied("The browser does not allow it: select the line."),
    );
  const about = `It is a secret; one module can join with it, once. A new one for ${name} replaces it.`;
  return html`<p>Run this on ${name} until ${until}. ${about}</p>
    <p><code class="token">${made.line}</code></p>
    ${navigator.clipboard && html`<button type="button" onClick=${copy}>Copy</button>`}
    <span role="status" class="muted said">${copied}</span>`;
}
