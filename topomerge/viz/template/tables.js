// Tables are sorted by a click on a column's head.

function startTable(table) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = head.dataset.name = head.textContent;
    head.replaceChildren(button);
    button.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      sortRows(table.tBodies[0], column, down ? -1 : 1);
    });
  });
}

function sortRows(body, column, sign) {
  const key = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent;
  const keyed = [...body.rows].map((row) => [key(row), row]);
  const number = keyed.every(([value]) => value !== "" && !Number.isNaN(Number(value)));
  keyed.sort(([a], [b]) => sign * (number ? a - b : a.localeCompare(b)));
  body.append(...keyed.map(([, row]) => row));
}

// What is searched for: rows of rooms and landmarks of the same section whose words hold it, and marks on its plans.

function startFind(input) {
  const section = input.closest("section");
  const rows = () => [...section.querySelectorAll("[data-words]")];
  input.addEventListener("input", () => {
    const words = input.value.trim().toLowerCase();
    for (const row of rows()) {
      const found = row.dataset.words.includes(words);
      row.classList.toggle("missed", !found);
      row.classList.toggle("found", words !== "" && found);
    }
    const first = words && rows().find((row) => row.matches(".found[data-room]"));
    if (!first) return light(null);
    light(placeOf(first));
    document.dispatchEvent(new CustomEvent("go", { detail: { place: placeOf(first), from: first } }));
  });
}
