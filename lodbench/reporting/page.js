"use strict";
const all = (selector, root = document) => [...root.querySelectorAll(selector)];

// Sorts a table by the column whose head is pressed; numbers by data-value, the rest by text,
// what is not known always last. Pressing again turns the order round.
for (const table of all("table.sortable")) {
  const heads = [...table.tHead.rows[table.tHead.rows.length - 1].cells];
  heads.forEach((head, column) => {
    const button = head.querySelector("button");
    if (!button) return;
    button.addEventListener("click", () => {
      const rises = head.getAttribute("aria-sort") !== "ascending";
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", rises ? "ascending" : "descending");
      const key = (row) => {
        const cell = row.cells[column];
        if (cell.dataset.value !== undefined) return Number(cell.dataset.value);
        const words = cell.textContent.trim();
        return words === "" || words === "-" ? null : words;
      };
      const order = (a, b) => {
        const [x, y] = [key(a), key(b)];
        if (x === null || y === null) return (x === null) - (y === null);
        const step = typeof x === "number" && typeof y === "number"
          ? x - y : String(x).localeCompare(String(y), "en", { numeric: true });
        return rises ? step : -step;
      };
      const body = table.tBodies[0];
      body.append(...[...body.rows].sort(order));
    });
  });
}

// Hides rows, and the pictures and cameras of hidden queries, that do not hold all words of the filter.
for (const input of all("input.filter")) {
  const rows = all("tbody tr", input.closest("section") ?? document);
  const count = input.closest(".tools").querySelector(".count");
  const apply = () => {
    const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
    const hidden = new Set();
    let shown = 0;
    for (const row of rows) {
      const text = row.textContent.toLowerCase();
      row.hidden = !words.every((word) => text.includes(word));
      shown += row.hidden ? 0 : 1;
      if (row.hidden && row.dataset.key) hidden.add(row.dataset.key);
    }
    for (const part of all("figure[data-key], g.spot")) {
      part.classList.toggle("hidden", hidden.has(part.dataset.key));
    }
    count.textContent = `${shown} of ${rows.length}`;
  };
  input.addEventListener("input", apply);
  apply();
}

// Opens a picture large; its row, its camera on the map and itself all lead there. Arrow keys turn the pages.
const viewer = document.querySelector("dialog.viewer");
const shown = () => all("figure[data-key]").filter((f) => f.querySelector("img") && !f.classList.contains("hidden"));
let current = null;
const show = (figure) => {
  current = figure;
  const image = figure.querySelector("img");
  const target = viewer.querySelector("img");
  target.src = image.src;
  target.alt = image.alt;
  viewer.querySelector("figcaption").textContent = figure.querySelector("figcaption").textContent;
  for (const part of all("[data-key]")) part.classList.toggle("current", part.dataset.key === figure.dataset.key);
  if (!viewer.open) viewer.showModal();
};
const turn = (step) => {
  const figures = shown();
  if (figures.length) show(figures[(figures.indexOf(current) + step + figures.length) % figures.length]);
};
const open = (key) => {
  const figure = shown().find((f) => f.dataset.key === key);
  const slides = figure?.closest(".slides");
  if (slides) {
    slides.turnTo(figure);
    slides.scrollIntoView({ block: "nearest", behavior: "smooth" });
  } else if (figure) show(figure);
};
viewer.querySelector(".close").addEventListener("click", () => viewer.close());
viewer.querySelector(".previous").addEventListener("click", () => turn(-1));
viewer.querySelector(".next").addEventListener("click", () => turn(1));
viewer.addEventListener("click", (event) => { if (event.target === viewer) viewer.close(); });
viewer.addEventListener("keydown", (event) => {
  if (event.key === "ArrowLeft") turn(-1);
  if (event.key === "ArrowRight") turn(1);
});
for (const figure of all("figure[data-key]")) {
  figure.querySelector("img")?.addEventListener("click", () => show(figure));
}
for (const row of all("tr[data-key]")) {
  row.addEventListener("click", () => open(row.dataset.key));
  row.addEventListener("keydown", (event) => { if (event.key === "Enter") open(row.dataset.key); });
}

// One picture at a time, by a slider and two buttons; its row and its camera on the map are marked.
for (const slides of all(".slides")) {
  const figures = all("figure", slides);
  const range = slides.querySelector("input[type=range]");
  slides.turnTo = (figure) => {
    figures.forEach((other) => { other.hidden = other !== figure; });
    range.value = figures.indexOf(figure);
    for (const part of all("[data-key]")) part.classList.toggle("current", part.dataset.key === figure.dataset.key);
  };
  const step = (by) => slides.turnTo(figures[(Number(range.value) + by + figures.length) % figures.length]);
  range.addEventListener("input", () => step(0));
  slides.querySelector(".previous").addEventListener("click", () => step(-1));
  slides.querySelector(".next").addEventListener("click", () => step(1));
  step(0);
}

// Moves and zooms a map by its viewBox, and says how long its bar is on the ground.
for (const map of all(".map")) {
  const svg = map.querySelector("svg");
  const box = svg.viewBox.baseVal;
  const start = [box.x, box.y, box.width, box.height];
  const spots = all("g.spot", map);
  const scale = () => Math.max(box.width / svg.clientWidth, box.height / svg.clientHeight);
  const tell = () => {
    const metres = 120 * scale();
    const round = 10 ** Math.floor(Math.log10(metres));
    const length = [5, 2, 1].map((n) => n * round).find((n) => n <= metres) ?? round;
    const bar = map.querySelector(".bar span");
    bar.style.width = `${length / scale()}px`;
    bar.textContent = length >= 1000 ? `${length / 1000} km` : `${length} m`;
    // Closer by, fewer are in view: they may be larger again.
    const inView = spots.length * Math.min(1, (box.width * box.height) / (start[2] * start[3]));
    for (const size of ["many", "crowd"]) map.classList.toggle(size, inView >= Number(map.dataset[size]));
  };
  const zoom = (factor, x, y) => {
    if (!factor) [box.x, box.y, box.width, box.height] = start;
    else {
      box.x = x + (box.x - x) * factor;
      box.y = y + (box.y - y) * factor;
      box.width *= factor;
      box.height *= factor;
    }
    tell();
  };
  const place = (event) => new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
  svg.addEventListener("wheel", (event) => {
    event.preventDefault();
    const at = place(event);
    zoom(1.0015 ** event.deltaY, at.x, at.y);
  }, { passive: false });
  let from = null;
  let way = 0;
  svg.addEventListener("pointerdown", (event) => { from = place(event); way = 0; });
  svg.addEventListener("pointermove", (event) => {
    if (!from || !event.buttons) return;
    const at = place(event);
    box.x += from.x - at.x;
    box.y += from.y - at.y;
    way += Math.abs(event.movementX) + Math.abs(event.movementY);
  });
  svg.addEventListener("pointerup", () => { from = null; });
  for (const button of all("[data-zoom]", map)) {
    button.addEventListener("click", () =>
      zoom(Number(button.dataset.zoom), box.x + box.width / 2, box.y + box.height / 2));
  }
  for (const spot of spots) {
    spot.addEventListener("click", () => { if (way < 6) open(spot.dataset.key); });
  }
  addEventListener("resize", tell);
  tell();
}
