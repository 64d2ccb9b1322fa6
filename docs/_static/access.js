// What the theme leaves out for readers without a mouse or a screen: levels of the sidebar's headings, and focus for
// blocks and tables that scroll sideways.
for (const heading of document.querySelectorAll("p.caption[role=heading]")) heading.setAttribute("aria-level", "2");
for (const block of document.querySelectorAll("pre, .table-wrapper")) block.tabIndex = 0;
