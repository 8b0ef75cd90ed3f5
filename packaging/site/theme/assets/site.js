// What is scrolled can be reached by the keyboard, of all the theme's blocks of code and tables. The theme gives a block of
// code a landmark of its own for its button, which is noise to a screen reader.
new MutationObserver(() => {
  for (const nav of document.querySelectorAll("nav.md-code__nav:not([role])")) nav.setAttribute("role", "none");
  const scrolled = ".md-typeset pre > code:not([tabindex]), .md-typeset__scrollwrap:not([tabindex])";
  for (const each of document.querySelectorAll(scrolled)) each.setAttribute("tabindex", "0");
}).observe(document.documentElement, { attributeFilter: ["tabindex"], childList: true, subtree: true });
