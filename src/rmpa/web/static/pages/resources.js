// Smart Resources, and one of them: profiles and why one of them runs, what clients asked, contexts, configuration.

import { useState, html, memo } from "../markup.js";
import { seconds } from "../format.js";
import { entries, section } from "../state.js";
import { Facts, Failure, Gone, Mark, Page, Panel } from "../parts.js";
import { Table } from "../lists.js";
import { Link, ModuleLink } from "../links.js";
import { Editable } from "../asking.js";
import { setting } from "../typed.js";

const Row = memo(
  ({ name, one }) =>
    html`<tr>
      <th scope="row">
        <${Link} page="resource" name=${name}>${one.name}<//>
        <div class="muted">${one.description}</div>
      </th>
      <td><${ModuleLink} name=${one.module} /></td>
      <td>${one.role}${one.physical ? "" : html` <span class="muted">simulated</span>`}</td>
      <td>
        <${Mark} state=${one.level} />
        <div class="muted">${one.message}</div>
      </td>
      <td>${one.profile || "none"}</td>
      <td>${one.context || "–"}</td>
      <td class="number">${one.clients || 0}</td>
    </tr>`,
);

export function Resources({ state }) {
  const all = entries(state, "resources");
  return html`<${Page} title="Smart Resources" kind=${`${all.length} in all modules`}
    ><${Panel}
      ><${Table}
        caption="Smart Resources"
        columns=${["Resource", "Module", "Role", "Quality", "Profile", "Context", "#Clients"]}
        empty="No module has a Smart Resource."
        list=${all}
      >
        ${([key, one]) => html`<${Row} key=${key} name=${key} one=${one} />`}<//
      ><//
    ><//
  >`;
}

export function ResourcePage({ name, state, connection }) {
  const one = section(state, "resources")[name];
  const [failure, setFailure] = useState(null);
  if (!one) return html`<${Page} title=${name} kind="Smart Resource"><${Gone} kind="resource" name=${name} /><//>`;
  const detail = section(section(state, "detail"), `resource:${name}`);
  const descriptor = section(detail, "descriptor"),
    decision = section(detail, "decision"),
    values = section(section(detail, "health"), "values");
  const whose = { resource: one.name, peer: one.module === section(state, "agent").name ? "" : one.module };
  const choose = (what, choice) => connection.ask(what, { ...whose, choice }).then(() => setFailure(null), setFailure);
  return html`<${Page}
    title=${one.name}
    kind=${`Smart Resource of ${one.module} · ${one.role || ""}${one.physical ? "" : ", simulated"}`}
    aside=${html`<${Mark} state=${one.level} word=${one.message || undefined} />`}
    ><div class="grid">
      <${Panel} title="State"
        ><p>${one.description}</p>
        <${Facts}
          rows=${[
            ["State", one.state],
            ["Profile", one.profile || "none runs"],
            ["Context", one.context || "none"],
            ["Chosen", decision.chosen ? `${decision.chosen}, by hand` : "by the resource"],
            ["Being applied", decision.applying],
            ["Last reaction", seconds(decision.reaction)],
            ["Alarm", decision.alarm],
          ]}
        /><${Failure} failure=${failure} /> ${(decision.conflicts || []).length > 0 &&
        html`<p class="failure">
          ${decision.conflicts.map((each) => (typeof each === "string" ? each : JSON.stringify(each))).join("; ")}
        </p>`}<//
      >
      <${Panel} title="Distance of each profile to what is asked"
        ><${Distances} scores=${decision.scores || []} profile=${one.profile}
      /><//>
      <${Panel} title="Profiles" wide
        ><${Profiles}
          descriptor=${descriptor}
          decision=${decision}
          one=${one}
          choose=${connection.may("control") ? (choice) => choose("profile", choice) : null}
      /><//>
      <${Panel} title="Why: each term of the decision" wide><${Terms} scores=${decision.scores || []} /><//>
      <${Panel} title="Quality"
        ><${Table}
          caption="Quality"
          columns=${["Attribute", "#Now", "Better", "Class"]}
          empty="It has measured nothing yet."
          >${(descriptor.attributes || [])
            .filter((each) => each.name in values)
            .map(
              (each) =>
                html`<tr key=${each.name}>
                  <th scope="row">${each.name}</th>
                  <td class="number">${quantity(values[each.name])}</td>
                  <td>${each.better === "max" ? "more" : each.better === "min" ? "less" : each.better}</td>
                  <td>${each.category}</td>
                </tr>`,
            )}<//
        ><//
      >
      <${Panel} title="Who asked what"
        ><${Table} caption="Clients" columns=${["Client", "Is told", "Asks"]} empty="No client asks for anything."
          >${(detail.clients || []).map(
            (client) =>
              html`<tr key=${client.name}>
                <th scope="row">${client.name}</th>
                <td><${Mark} state=${client.level} word=${client.message} /></td>
                <td>
                  ${Object.entries(client.values || {}).map(
                    ([key, value]) => html`<div key=${key}>${key} ${value}</div>`,
                  )}
                </td>
              </tr>`,
          )}<//
        ><//
      >
      <${Panel} title="Contexts"
        ><${Table}
          caption="Contexts"
          columns=${["Context", "When", "Requires", "Profiles", ""]}
          empty="It has no contexts."
          >${(detail.contexts || descriptor.contexts || []).map(
            (each) =>
              html`<tr key=${each.name}>
                <th scope="row">
                  ${each.name === one.context ? html`<${Mark} state="up" word=${each.name} />` : each.name}
                </th>
                <td>${each.when || "by hand"}</td>
                <td>
                  ${Object.entries(each.requires || {})
                    .map(([key, value]) => `${key} ${value}`)
                    .join(", ") || "–"}
                </td>
                <td>${(each.profiles || []).join(", ") || "all"}</td>
                <td class="number">
                  ${connection.may("control") &&
                  html`<button
                    type="button"
                    onClick=${() => choose("context", each.name === one.context ? "" : each.name)}
                  >
                    ${each.name === one.context ? "Leave" : "Enter"}
                  </button>`}
                </td>
              </tr>`,
          )}<//
        ><//
      >
      <${Panel} title="Configuration"
        ><${Table}
          caption="Parameters"
          columns=${["Parameter", "#Value", "Range", "Description"]}
          empty="It has no parameters."
          >${(descriptor.parameters || []).map(
            (each) =>
              html`<tr key=${each.name}>
                <th scope="row">${each.name}</th>
                <td class="number">
                  <${Setting}
                    value=${section(detail, "parameters")[each.name] ?? each.default}
                    about=${each}
                    set=${connection.may("control")
                      ? (value) => connection.ask("configure", { ...whose, name: each.name, value })
                      : null}
                  />
                </td>
                <td>
                  ${each.choices?.length
                    ? each.choices.join(" | ")
                    : each.low !== undefined || each.high !== undefined
                      ? `${each.low ?? ""} … ${each.high ?? ""}`
                      : each.type}
                </td>
                <td>${each.description}</td>
              </tr>`,
          )}<//
        ><//
      >
      <${Panel} title="Topics"
        ><${Table} caption="Topics" columns=${["Topic", "Way", "Type", "Contract"]}
          >${[
            ["outputs", "out"],
            ["inputs", "in"],
          ].flatMap(([list, way]) =>
            (descriptor[list] || []).map(
              (each) =>
                html`<tr key=${way + each.topic}>
                  <th scope="row"><${Link} page="topic" name=${each.topic} /></th>
                  <td>${way}</td>
                  <td>${each.type}</td>
                  <td>
                    ${Object.entries(each.contract || {})
                      .map(([key, value]) => `${key} ${value}`)
                      .join(", ") || "–"}
                  </td>
                </tr>`,
            ),
          )}<//
        ><//
      >
    </div><//
  >`;
}

// A parameter's value; with the right to, it can be changed. What the resource made of it is said.
function Setting({ value, about, set }) {
  const written = typeof value === "string" ? value : JSON.stringify(value);
  const shown = `${written || "–"} ${about.unit || ""}`.trim();
  if (!set) return shown;
  const save = (draft) => {
    const typed = setting(draft, about);
    if (typed.error) return Promise.resolve({ failure: typed });
    return set(typed.value).then(
      (answer) => ({ said: answer.text }),
      (failure) => ({ failure }),
    );
  };
  const choices = about.choices?.length ? about.choices.map(String) : about.type === "bool" ? ["true", "false"] : null;
  return html`<${Editable}
    label=${about.name}
    shown=${shown}
    begin=${written ?? ""}
    save=${save}
    choices=${choices}
  />`;
}

// "0.000797688 m/s²" with four digits.
function quantity(text) {
  const [number, ...unit] = text.split(" ");
  return Number.isFinite(Number(number)) && number !== ""
    ? [Number(Number(number).toPrecision(4)), ...unit].join("\u2009")
    : text;
}

const offers = (profile, units) =>
  Object.entries(profile.offers || {})
    .map(([key, value]) => `${key} ${value}${units[key] ? `\u2009${units[key]}` : ""}`)
    .join(", ") || "–";

function Profiles({ descriptor, decision, one, choose }) {
  const units = Object.fromEntries((descriptor.attributes || []).map((each) => [each.name, each.unit]));
  return html`<${Table}
    caption="Profiles"
    columns=${["Profile", "Offers", "#Cost", "Description", ""]}
    empty="It has no profiles."
    >${(descriptor.profiles || []).map(
      (each) =>
        html`<tr key=${each.name}>
          <th scope="row">
            ${each.name === one.profile ? html`<${Mark} state="up" word=${`${each.name} runs`} />` : each.name}
          </th>
          <td>${offers(each, units)}</td>
          <td class="number">${each.cost}</td>
          <td>${each.description}</td>
          <td class="number">
            ${choose &&
            html`<button type="button" onClick=${() => choose(decision.chosen === each.name ? "" : each.name)}>
              ${decision.chosen === each.name ? "Let it decide" : "Choose"}
            </button>`}
          </td>
        </tr>`,
    )}<//
  >`;
}

// A bar for each profile: how far it is from what is asked. The nearest feasible one runs.
function Distances({ scores, profile }) {
  if (!scores.length) return html`<p class="empty">No decision has been made yet.</p>`;
  const finite = scores.map((each) => each.distance).filter(Number.isFinite);
  const most = Math.max(...finite, 0.01);
  const tall = 34;
  return html`<svg
      class="bars"
      viewBox=${`0 0 400 ${scores.length * tall + 4}`}
      role="img"
      aria-label=${scores
        .map((each) => {
          const excluded = each.excluded ? `, excluded: ${each.excluded}` : "";
          return `${each.profile}: distance ${each.distance ?? "unbounded"}${excluded}`;
        })
        .join("; ")}
    >
      ${scores.map((each, at) => {
        const y = at * tall + 4;
        const length = Math.max(2, (Math.min(each.distance ?? most, most) / most) * 200);
        return html`<g key=${each.profile}>
          <text x="0" y=${y + 17}>${each.profile === profile ? "● " : ""}${each.profile}</text
          ><rect class="track" x="130" y=${y + 4} width="200" height="16" rx="3" />
          <rect
            class=${each.excluded || !each.feasible ? "hard" : each.profile === profile ? "soft" : "none"}
            x="130"
            y=${y + 4}
            width=${length}
            height="16"
            rx="3"
          />
          <text x="338" y=${y + 17}
            >${each.excluded ? "excluded" : !each.feasible ? "infeasible" : cell(each.distance)}</text
          ></g
        >`;
      })}
    </svg>
    <p class="muted">Shorter is nearer to what is asked for. Red: it cannot be chosen.</p>`;
}

const cell = (value) =>
  value === undefined || value === null
    ? "–"
    : typeof value === "number"
      ? Number(value.toPrecision(4))
      : typeof value === "object"
        ? JSON.stringify(value)
        : String(value);

function Terms({ scores }) {
  const terms = scores.flatMap((score) => (score.terms || []).map((term) => [score, term]));
  const keys = [...new Set(terms.flatMap(([, term]) => Object.keys(term)))];
  const rest = scores.filter((each) => !(each.terms || []).length);
  return html`${terms.length > 0 &&
  html`<${Table} caption="Terms" columns=${["Profile", ...keys]}
    >${terms.map(
      ([score, term], at) =>
        html`<tr key=${at}>
          <th scope="row">${score.profile}</th>
          ${keys.map((key) => html`<td key=${key}>${cell(term[key])}</td>`)}
        </tr>`,
    )}<//
  >`}
  ${rest.map(
    (each) =>
      html`<p key=${each.profile} class="empty">
        ${each.profile}:${" "}${each.excluded ||
        `nothing is asked of it; its distance ${cell(each.distance)} is its cost alone`}
      </p>`,
  )}`;
}
