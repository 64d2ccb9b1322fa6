// What the theme leaves out for readers without a mouse or a screen: levels of the sidebar's headings, and focus for
// blocks, tables and, on a phone, wide pictures, that scroll sideways.
for (const heading of document.querySelectorAll("p.caption[role=heading]")) heading.setAttribute("aria-level", "2");
for (const image of document.querySelectorAll("article img")) {
  const mark = () => {
    if (image.naturalWidth <= 700) return;
    image.classList.add("wide");
    image.parentElement.tabIndex = 0;
  };
  image.complete ? mark() : image.addEventListener("load", mark);
}
for (const block of document.querySelectorAll("pre, .table-wrapper")) block.tabIndex = 0;
// Parameters of a long signature come as a <dl> without a <dt>.
for (const part of document.querySelectorAll("dt dl")) {
  part.role = "list";
  for (const line of part.children) line.role = "listitem";
}
// A table without a head has an empty one.
for (const head of document.querySelectorAll("thead")) if (!head.textContent.trim()) head.remove();
