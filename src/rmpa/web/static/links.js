// Links to pages, and the names of nodes.

import { html } from "./markup.js";

export const href = (page, name) => (name === undefined ? `#/${page}` : `#/${page}/${encodeURIComponent(name)}`);
export const Link = ({ page, name, children }) => html`<a href=${href(page, name)}>${children || name}</a>`;

// A node as it is named in the state: `MODULE:/name` for a peer's. People read the name that the graph of this module
// has, as in rosnode, rosbridge and Foxglove: its proxy's, `/rmpa/MODULE/name`.
export const nodeKey = (module, node) => (module ? `${module}:${node}` : node);
export const nodeName = (key) => key.replace(/^([^/:]+):(?=\/)/, "/rmpa/$1");
export const keyOfNode = (name) => name.replace(/^\/rmpa\/([^/]+)(?=\/)/, "$1:");
export const NodeLink = ({ name, children }) =>
  html`<a class="mono" href=${href("node", keyOfNode(name))}>${children?.length ? children : nodeName(name)}</a>`;
export const NodeLinks = ({ names }) =>
  names.map((name, at) => html`${at > 0 && ", "}<${NodeLink} key=${name} name=${name} />`);
export const ModuleLink = ({ name }) => html`<a class="whole" href=${href("module", name)}>${name}</a>`;
