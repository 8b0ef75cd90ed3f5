// Dark or light: as the system says, until the user chooses.

const KEY = "rmpa.theme";
const system = () => (matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark");
function stored() {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null;
  }
}

export const theme = () => document.documentElement.dataset.theme || stored() || system();

export function applyTheme() {
  const chosen = stored();
  if (chosen === "dark" || chosen === "light") document.documentElement.dataset.theme = chosen;
}

export function nextTheme() {
  const next = theme() === "dark" ? "light" : "dark";
  document.documentElement.dataset.theme = next;
  try {
    localStorage.setItem(KEY, next);
  } catch {
    /* a private window: the choice lasts as long as the page */
  }
}

// The value of a colour, or of another property of the style.
export const ink = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// Calls `changed` when the user chooses other colours, until the function that it returns is called.
export function onTheme(changed) {
  const themes = new MutationObserver(changed);
  themes.observe(document.documentElement, { attributeFilter: ["data-theme"] });
  return () => themes.disconnect();
}
