// The frame around all pages: address, navigation, search, keys, colours, and what to say when the agent is gone.

import { Component, html, render } from "./markup.js";
import { Connection } from "./connection.js";
import { sentence } from "./format.js";
import { section } from "./state.js";
import { IconButton, Mark, Since } from "./parts.js";
import { keep, kept } from "./lists.js";
import { keyOfNode } from "./links.js";
import { Mandala } from "./mandala.js";
import { Search, Shortcuts } from "./search.js";
import { applyTheme, nextTheme, theme } from "./theme.js";

const ICON = html`<img src="static/icon.svg" alt="" width="28" height="28" />`;
// Pages by address: title and key of those in the navigation, and the file and export of all but the first one, which
// are loaded when they are first opened.
const PLACES = {
  "": ["Mesh", "m"],
  topics: ["Topics", "t", "topics.js", "Topics"],
  services: ["Services", "s", "services.js", "Services"],
  nodes: ["Nodes", "n", "nodes.js", "Nodes"],
  graph: ["Graph", "g", "graph.js", "GraphPage"],
  params: ["Parameters", "p", "params.js", "Params"],
  resources: ["Resources", "r", "resources.js", "Resources"],
  top: ["Top", "u", "top.js", "Top"],
  map: ["Map", "o", "map.js", "MapPage"],
  tf: ["Frames", "f", "tf.js", "FramesPage"],
  panels: ["Panels", "b", "panels.js", "Panels"],
  alarms: ["Alarms", "a", "alarms.js", "Alarms"],
  diagnostics: ["Diagnostics", "i", "diagnostics.js", "Diagnostics"],
  log: ["Log", "l", "log.js", "Log"],
  recordings: ["Recordings", "e", "recordings.js", "Recordings"],
  drive: ["Drive", "d", "drive.js", "DrivePage"],
  module: ["", "", "module.js", "ModulePage"],
  topic: ["", "", "topics.js", "TopicPage"],
  service: ["", "", "services.js", "ServicePage"],
  node: ["", "", "nodes.js", "NodePage"],
  resource: ["", "", "resources.js", "ResourcePage"],
  file: ["", "", "description.js", "DescriptionPage"],
  recording: ["", "", "recordings.js", "RecordingPage"],
};
const PAGES = Object.entries(PLACES).flatMap(([page, [title, key]]) => (title ? [[page, title, key]] : []));
const LAZY = Object.fromEntries(Object.entries(PLACES).map(([page, [, , ...where]]) => [page, where]));
const LISTED = { topic: "topics", service: "services", node: "nodes", resource: "resources", module: "" };
// Pages that are a part of another one.
const WITHIN = { file: "resources", recording: "recordings" };
// What pages without a name look at.
const LISTS = { diagnostics: [["diagnostics", ""]], panels: [["diagnostics", ""]], topics: [["rates", ""]] };
// Pages on which a name chooses a part: what was filtered and opened there stays.
const KEPT = ["diagnostics", "graph"];

function address() {
  const [page = "", name] = location.hash.replace(/^#\/?/, "").split("/");
  try {
    const known = name === undefined ? undefined : decodeURIComponent(name);
    return { page, name: page === "node" && known ? keyOfNode(known) : known };
  } catch {
    return { page, name };
  }
}

class App extends Component {
  constructor() {
    super();
    this.state = { ...address(), overlay: "" };
    this.drawn = [];
    this.connection = new Connection((done) => this.draw(done));
    this.look();
  }

  componentDidMount() {
    addEventListener("hashchange", () => {
      this.arrives = !KEPT.includes(address().page) || address().page !== this.state.page;
      clearTimeout(this.scrolled);
      this.setState({ ...address(), overlay: "" }, () => this.look());
    });
    history.scrollRestoration = "manual"; // what is to be scrolled may still have to be drawn
    const place = () => keep({ scroll: Math.round(scrollY) });
    addEventListener("scroll", () => {
      clearTimeout(this.scrolled);
      this.scrolled = setTimeout(place, 200);
    });
    addEventListener("click", () => scrollY !== (kept().scroll || 0) && place(), true); // a link leaves the page
    addEventListener("keydown", (event) => this.key(event));
    window.rmpa = this.connection; // for the console and for tests
  }

  // The heading of another page gets the focus as soon as there is one: the page may have to be loaded first.
  componentDidUpdate() {
    this.showPage();
    const heading = this.arrives && document.querySelector("main h1");
    if (!heading) return;
    this.arrives = false;
    heading.focus({ preventScroll: true });
    scrollTo(0, kept().scroll || 0);
  }

  // Where the row of pages is longer than the screen, the present one is scrolled to.
  showPage() {
    const link = document.querySelector(".top nav [aria-current]");
    if (!link || link === this.shown) return;
    this.shown = link;
    const row = link.parentElement;
    row.scrollLeft = link.offsetLeft + link.offsetWidth / 2 - row.clientWidth / 2;
  }

  // Many messages, one drawing: in the next frame, or soon where none comes, as in a tab that is or becomes hidden.
  draw(done) {
    if (done) this.drawn.push(done);
    if (this.waits) return;
    this.waits = true;
    const now = () => {
      cancelAnimationFrame(frame);
      clearTimeout(timer);
      this.waits = false;
      this.setState({}, () => {
        for (const each of this.drawn.splice(0)) each();
      });
    };
    const frame = requestAnimationFrame(now);
    const timer = setTimeout(now, 200);
  }

  look() {
    const { page, name } = address();
    const about = page === "diagnostics" ? "diagnostic" : page in LISTED && page;
    const lists = LISTS[page] ?? [];
    this.connection.look(about && name !== undefined ? [...lists, [about, name]] : lists);
  }

  key(event) {
    if (event.key === "Escape" && this.state.overlay) return this.setState({ overlay: "" });
    const field = event.target.closest?.("input, textarea, select, [contenteditable]");
    if (field || event.ctrlKey || event.metaKey || event.altKey || this.state.overlay) {
      if (!(event.key === "k" && (event.ctrlKey || event.metaKey))) return;
    }
    if (event.key === "/" || event.key === "k") {
      event.preventDefault();
      return this.setState({ overlay: "search" });
    }
    if (event.key === "?") return this.setState({ overlay: "keys" });
    if (event.key === "c") return this.turn();
    if (event.key === "w") {
      [...document.querySelectorAll(".question button")].find((each) => each.textContent === "Why?")?.click();
      return;
    }
    if (this.prefix) {
      this.prefix = false;
      const found = PAGES.find(([, , key]) => key === event.key);
      if (found) location.hash = `#/${found[0]}`;
    } else if (event.key === "g") {
      this.prefix = true;
      setTimeout(() => (this.prefix = false), 1500);
    }
  }

  turn() {
    nextTheme();
    this.setState({});
  }

  // Once at a time: where it fails, again after a while.
  load(file) {
    this.loading ??= new Set();
    if (this.loading.has(file)) return;
    this.loading.add(file);
    import(`./pages/${file}`).then(
      (module) => {
        this.loaded = { ...this.loaded, [file]: module };
        this.setState({ broken: false });
      },
      () => {
        this.setState({ broken: true });
        setTimeout(() => {
          this.loading.delete(file);
          this.setState({});
        }, 3000);
      },
    );
  }

  page() {
    const { page, name } = this.state;
    const { connection } = this;
    if (!page) return html`<${Mandala} state=${connection.state} connection=${connection} />`;
    const lazy = LAZY[page];
    if (!lazy) return html`<p class="empty">There is no page <code>${page}</code>. <a href="#/">The mesh</a></p>`;
    const loaded = this.loaded?.[lazy[0]];
    if (!loaded) {
      this.load(lazy[0]);
      return html`<p class="empty">
        ${this.state.broken ? "This page cannot be loaded: rmpa web does not answer." : "Loading …"}
      </p>`;
    }
    const key = KEPT.includes(page) ? page : `${page} ${name}`;
    return html`<${loaded[lazy[1]]} ...${{ key, name, connection, state: connection.state, pages: LAZY }} />`;
  }

  banner() {
    const { connection } = this;
    const reach = section(connection.state, "reach");
    const { notice } = connection;
    const close = () => {
      connection.notice = null;
      this.setState({});
    };
    if (connection.phase === "lost") {
      const known = connection.state ? "What is shown and typed stays here, but nothing can be sent." : "";
      return html`<${Banner} mark="refused" action="Try now" act=${() => connection.retry()}>
        <strong>No connection to <code>rmpa web</code></strong> for <${Since} moment=${connection.lostAt / 1000} />.
        ${" "}${sentence(connection.reason)} ${known} The page connects again by itself.<//
      >`;
    }
    if (reach.ok === false)
      return html`<${Banner} mark="refused"
        ><strong>The agent has not answered</strong> for <${Since} moment=${reach.since} />.
        ${" "}${sentence(reach.error)} ${sentence(reach.remedy)} The page shows what was last known. This page comes
        back by itself.<//
      >`;
    if (notice)
      return html`<${Banner} mark="WARN" action="Close" act=${close}>
        ${sentence(notice.error)} ${sentence(notice.remedy)}<//
      >`;
    return null;
  }

  render() {
    const { connection } = this;
    const { page, overlay } = this.state;
    const state = connection.state;
    const agent = section(state, "agent").name || connection.hello.agent;
    const alarms = Object.keys(section(state, "alarms")).length;
    const gone = connection.phase === "lost" || section(state, "reach").ok === false;
    const current = LISTED[page] ?? WITHIN[page] ?? page;
    const dark = theme() === "dark";
    const skip = (event) => {
      event.preventDefault();
      document.querySelector("h1")?.focus();
    };
    return html`<a class="skip" href="#main" onClick=${skip}>To the content</a>
      <header class="top">
        <a class="brand" href="#/"
          >${ICON}<span>RMPA<small>${agent || "…"}</small></span></a
        >
        <nav aria-label="Pages">
          ${PAGES.filter(
            ([each]) => each !== "drive" || connection.hello.may.includes("drive") || page === "drive",
          ).map(
            ([each, title]) =>
              html`<a key=${each} href=${`#/${each}`} aria-current=${each === current ? "page" : undefined}
                >${title}${each === "alarms" && alarms > 0
                  ? html`<b class="badge"
                      >${alarms}<span class="unseen"> ${alarms > 1 ? "alarms stand" : "alarm stands"}</span></b
                    >`
                  : ""}</a
              >`,
          )}
        </nav>
        <div class="tools">
          <${IconButton} label="Search (/)" press=${() => this.setState({ overlay: "search" })}>
            <svg viewBox="0 0 20 20" aria-hidden="true">
              <circle cx="8.5" cy="8.5" r="5.5" />
              <path d="m12.5 12.5 5 5" /></svg
          ><//>
          <${IconButton}
            label=${dark ? "Light colours (c)" : "Dark colours (c)"}
            title="Colours (c)"
            press=${() => this.turn()}
          >
            <svg viewBox="0 0 20 20" aria-hidden="true">
              <circle cx="10" cy="10" r="7" />
              <path class="fill" d="M10 3a7 7 0 0 1 0 14Z" /></svg
          ><//>
          <${IconButton} label="Keys (?)" look="help" press=${() => this.setState({ overlay: "keys" })}>
            <svg viewBox="0 0 20 20" aria-hidden="true">
              <path d="M7 7.5a3 3 0 1 1 4.5 2.6c-1 .6-1.5 1.1-1.5 2.4M10 15.5v.5" /></svg
          ><//>
        </div>
      </header>
      ${this.banner()}
      <main id="main" class=${gone ? "gone" : ""}>
        ${state
          ? this.page()
          : html`<p class="loading">${connection.phase === "lost" ? "Nothing is known yet." : "Connecting …"}</p>`}
      </main>
      ${overlay === "search" &&
      html`<${Search} state=${state} connection=${connection} onClose=${() => this.setState({ overlay: "" })} />`}
      ${overlay === "keys" && html`<${Shortcuts} pages=${PAGES} onClose=${() => this.setState({ overlay: "" })} />`}`;
  }
}

const Banner = ({ mark, action, act, children }) =>
  html`<div class="banner ${mark === "WARN" ? "warn" : "bad"}" role="status">
    <${Mark} state=${mark} word="" /><span>${children}</span>${act &&
    html`<button type="button" onClick=${act}>${action}</button>`}
  </div>`;

applyTheme();
const root = document.getElementById("app");
root.textContent = "";
render(html`<${App} />`, root);
