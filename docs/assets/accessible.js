// What the theme leaves out for readers with a keyboard or a screen reader.
const mend = () => {
  for (const each of document.querySelectorAll("pre code, .md-typeset__scrollwrap, .md-sidebar__scrollwrap")) {
    each.tabIndex = 0; // what scrolls can be scrolled by keyboard
  }
  document.querySelector(".md-search")?.setAttribute("aria-label", "Search");
  // Parts of one navigation are no landmarks of their own; each block's buttons are.
  for (const nav of document.querySelectorAll("nav.md-nav nav.md-nav")) {
    for (const name of ["aria-label", "aria-labelledby", "aria-expanded"]) nav.removeAttribute(name);
    nav.setAttribute("role", "none");
  }
  document.querySelectorAll(".md-code__nav").forEach((nav, k) => nav.setAttribute("aria-label", `Code ${k + 1}`));
  for (const head of document.querySelectorAll("th:empty")) {
    head.replaceWith(document.createElement("td"));
  }
};
document.addEventListener("DOMContentLoaded", mend);
