/* The sortable table of every metric. */
const table = { column: 0, ascending: true };

/** Draw the table for the scenario, or for all of them. */
function drawTable() {
  const all = document.getElementById("all-scenarios").checked;
  const shown = all ? FACTS.scenarios.map((_, i) => i) : [chosen.scenario];
  const rows = shown.flatMap((s) => FACTS.scenarios[s].rows.map((row, c) => ({ ...row, s, c })));
  const best = shown.map((s) => [s, FACTS.columns.map((column, i) => bestOf(s, column, i))]);
  rows.sort(inOrder);
  const bodies = rows.map((row) => bodyRow(row, all, new Map(best).get(row.s)));
  document.getElementById("metrics").replaceChildren(tableHead(all), make("tbody", {}, ...bodies));
  const scenario = FACTS.scenarios[chosen.scenario];
  document.getElementById("table-note").textContent = all
    ? "Every scenario of this run."
    : `${scenario.name}: ${scenario.meaning}. ${crystals(scenario.seeds.length)}.`;
}

/** "500 crystals", "1 crystal". */
function crystals(count) {
  return `${count.toLocaleString("en-GB")} crystal${count === 1 ? "" : "s"}`;
}

/** The lowest (or highest) mean of a column among those that read sensors; nothing where it is no contest. */
function bestOf(s, column, i) {
  if (!column.contest) return null;
  const means = FACTS.scenarios[s].rows
    .filter((row, c) => row.cells[i] && !FACTS.controllers[c].bound)
    .map((row) => row.cells[i][0]);
  return column.more_is_better ? Math.max(...means) : Math.min(...means);
}

/** Sort key of a row in the chosen column; -1 is the name. */
function keyOf(row) {
  if (table.column < 0) return FACTS.controllers[row.c].name;
  const cell = row.cells[table.column];
  return cell ? cell[0] : null;
}

/** Order of two rows; those without a value come last either way, ties in the order of the run. */
function inOrder(one, other) {
  const [a, b] = [keyOf(one), keyOf(other)];
  if (a === null || b === null) return (a === null) - (b === null) || one.s - other.s || one.c - other.c;
  const order = typeof a === "string" ? a.localeCompare(b, "en") : a - b;
  return (table.ascending ? order : -order) || one.s - other.s || one.c - other.c;
}

function tableHead(all) {
  const groups = make("tr", { class: "groups" }, make("td", { colspan: all ? 2 : 1 }));
  const names = make("tr", { class: "names" }, heading(-1, "controller", "", "left"));
  if (all) names.append(make("th", { scope: "col", class: "left" }, make("button", { type: "button", disabled: true }, "scenario")));
  FACTS.columns.forEach((column, i) => {
    const begins = i === 0 || FACTS.columns[i - 1].group !== column.group;
    if (begins) {
      const span = FACTS.columns.filter((one) => one.group === column.group).length;
      groups.append(make("th", { colspan: span, scope: "colgroup", class: "edge" }, column.group));
    }
    names.append(heading(i, column.name, column.unit, begins ? "edge" : ""));
  });
  return make("thead", {}, groups, names);
}

/** A heading whose button sorts by its column. */
function heading(i, name, unit, kind) {
  const sort = table.column !== i ? "none" : table.ascending ? "ascending" : "descending";
  const button = make("button", { type: "button" }, name, make("span", { class: "unit" }, unit && `[${unit}]`));
  button.addEventListener("click", () => {
    const first = i < 0 || !FACTS.columns[i].more_is_better;
    table.ascending = table.column === i ? !table.ascending : first;
    table.column = i;
    drawTable();
    document.querySelector(`#metrics th[data-column="${i}"] button`).focus();
  });
  return make("th", { scope: "col", class: kind, "aria-sort": sort, "data-column": i }, button);
}

function bodyRow(row, all, best) {
  const controller = FACTS.controllers[row.c];
  const name = make("th", { scope: "row" }, label(controller));
  if (row.crystals < FACTS.scenarios[row.s].seeds.length) name.append(make("small", {}, `first ${crystals(row.crystals)}`));
  if (controller.bound) name.append(make("small", {}, "bound: told what no sensor shows"));
  const line = make("tr", {}, name);
  if (all) line.append(make("td", { class: "left" }, FACTS.scenarios[row.s].name));
  FACTS.columns.forEach((column, i) => {
    const begins = i === 0 || FACTS.columns[i - 1].group !== column.group;
    const cell = row.cells[i];
    const is = [begins ? "edge" : "", cell && cell[0] === best[i] && !controller.bound ? "best" : ""].join(" ").trim();
    line.append(make("td", { class: is }, ...(cell ? written(cell, column.decimals) : ["–"])));
  });
  return line;
}

/** A mean and, below it, its interval. */
function written([mean, low, high], decimals) {
  const text = number(mean, decimals);
  return low === undefined ? [text] : [text, make("small", {}, interval(low, high, decimals))];
}
