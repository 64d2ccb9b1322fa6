/* What table and pictures share: elements, numbers, names, the look of a plot. Names are untrusted: text alone. */
const INK = "#1b1f24", SOFT = "#5a626c", GRID = "#e6e9ec";
const FONT = 'system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, "Liberation Sans", sans-serif';
/* Buttons by name: plotly's own choice would add one that sends the plot away. */
const BUTTONS = [["toImage", "zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"]];
const CONFIG = { displaylogo: false, responsive: true, modeBarButtons: BUTTONS };

/** A new element with attributes and children; strings become text. */
function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === true) element.setAttribute(name, "");
    else if (value !== false) element.setAttribute(name, value);
  }
  element.append(...children);
  return element;
}

/** A name as plotly may draw it: its own markup switched off, one line, not too long. */
function plain(name) {
  const short = name.length > 32 ? `${name.slice(0, 31)}…` : name;
  return short.replace(/[\u0000-\u001f\u007f-\u009f]/g, " ")
    .replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
}

/** A number with so many decimals, a true minus sign and no negative zero. */
function number(value, decimals) {
  const text = value.toFixed(decimals);
  return text.startsWith("-") ? (/[1-9]/.test(text) ? `\u2212${text.slice(1)}` : text.slice(1)) : text;
}

/** An interval: a dash between positive ends, a word where a minus sign would be taken for one. */
function interval(low, high, decimals) {
  return `${number(low, decimals)}${low < 0 || high < 0 ? " to " : "\u2013"}${number(high, decimals)}`;
}

/** Colour dot and name of a controller. */
function label(controller) {
  const name = make("span", { class: "name", title: `${controller.name}: ${controller.meaning}` }, controller.name);
  return make("span", {}, make("i", { class: "swatch", style: `--colour: ${controller.colour}` }), name);
}

/** The house's axis. */
function axis(changes) {
  return {
    gridcolor: GRID, zeroline: false, linecolor: "#8b929a", showline: true, ticks: "outside", ticklen: 3,
    tickcolor: "#8b929a", tickfont: { size: 11 }, automargin: false, ...changes,
  };
}

/** The house's layout. */
function layout(changes) {
  return {
    font: { family: FONT, size: 12, color: INK }, paper_bgcolor: "#fff", plot_bgcolor: "#fff", separators: ".",
    hoverlabel: { font: { size: 12, family: FONT }, namelength: -1 }, ...changes,
  };
}

/** A colour with an opacity. */
function faded(colour, opacity) {
  const part = (at) => parseInt(colour.slice(at, at + 2), 16);
  return `rgba(${part(1)},${part(3)},${part(5)},${opacity})`;
}
