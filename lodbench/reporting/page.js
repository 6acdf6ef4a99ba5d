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
          ? (x > y) - (x < y) : String(x).localeCompare(String(y), "en", { numeric: true });
        return rises ? step : -step;
      };
      const body = table.tBodies[0];
      body.append(...[...body.rows].sort(order));
      table.dispatchEvent(new Event("rows", { bubbles: true }));
    });
  });
}

// What a reader may ask of a cell besides words; a number that is not known is never within bounds.
const tests = {
  least: (cell, wanted) => Number(cell.dataset.value) >= Number(wanted),
  most: (cell, wanted) => Number(cell.dataset.value) <= Number(wanted),
  is: (cell, wanted) => cell.textContent.trim() === wanted,
  has: (cell, wanted) => {
    const tags = all(".tag", cell).map((tag) => `=${tag.textContent}`);
    return wanted === "-" ? !tags.length : tags.includes(wanted);
  },
};

// Hides rows, and the pictures and cameras of hidden queries, that do not hold all words of the filter, or
// do not meet a condition beside it.
for (const input of all("input.filter")) {
  const rows = all("tbody tr", input.closest("section") ?? document);
  const count = input.closest(".tools").querySelector(".count");
  const conditions = all(".condition", input.closest(".tools"));
  const column = (name) => all("thead th", input.closest("section")).findIndex((head) => head.dataset.name === name);
  const apply = () => {
    const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
    const hidden = new Set();
    const asked = conditions.filter((each) => each.value !== "").map((each) => ({
      at: column(each.dataset.column), test: tests[each.dataset.test], wanted: each.value }));
    let shown = 0;
    for (const row of rows) {
      const text = row.textContent.toLowerCase();
      row.hidden = !words.every((word) => text.includes(word))
        || !asked.every(({ at, test, wanted }) => test(row.cells[at], wanted));
      shown += row.hidden ? 0 : 1;
      if (row.hidden && row.dataset.key) hidden.add(row.dataset.key);
    }
    for (const part of all("figure[data-key], g.spot")) {
      part.classList.toggle("hidden", hidden.has(part.dataset.key));
    }
    count.textContent = `${shown} of ${rows.length}`;
    input.dispatchEvent(new Event("rows", { bubbles: true }));
  };
  for (const each of [input, ...conditions]) each.addEventListener("input", apply);
  apply();
}

// Opens a picture large; its row, its camera on the map and itself all lead there. Arrow keys turn the pages.
const viewer = document.querySelector("dialog.viewer");
const shown = () => all("figure[data-key]").filter((f) =>
  (f.querySelector("img") || f.closest(".slides")) && !f.classList.contains("hidden"));
let current = null;
const show = (figure) => {
  current = figure;
  // All that lies over each other, or the one picture.
  viewer.querySelector(".stack").replaceChildren(...all("img", figure).map((image) => image.cloneNode()));
  viewer.querySelector("figcaption").textContent = figure.querySelector("figcaption").textContent;
  for (const part of all("[data-key]")) part.classList.toggle("current", part.dataset.key === figure.dataset.key);
  if (!viewer.open) viewer.showModal();
};
const turn = (step) => {
  const slides = current.closest(".slides");
  const figures = (slides ? slides.order() : shown()).filter((f) => f.querySelector("img"));
  if (!figures.length) return;
  const next = figures[(figures.indexOf(current) + step + figures.length) % figures.length];
  slides?.turnTo(next);
  show(next);
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
  for (const image of all("img", figure)) image.addEventListener("click", () => show(figure));
}
for (const row of all("tr[data-key]")) {
  row.addEventListener("click", (event) => { if (!event.target.closest("a")) open(row.dataset.key); });
  row.addEventListener("keydown", (event) => {
    if (event.key === "Enter" && event.target === row) open(row.dataset.key);
  });
}

// One picture at a time, by a slider and two buttons, in the order of the rows, hidden ones left out; its row
// and its camera on the map are marked.
for (const slides of all(".slides")) {
  const figures = all("figure", slides);
  const range = slides.querySelector("input[type=range]");
  const twin = slides.querySelector("input.twin");
  slides.order = () => {
    const rows = new Map(all("tr[data-key]").map((row, at) => [row.dataset.key, row.hidden ? -1 : at]));
    const at = (figure) => rows.get(figure.dataset.key) ?? 0;
    return figures.filter((figure) => at(figure) >= 0).sort((a, b) => at(a) - at(b));
  };
  slides.turnTo = (figure) => {
    const order = slides.order();
    const neighbour = twin?.checked ? order[order.indexOf(figure) + 1] : null;
    figures.forEach((other) => { other.hidden = other !== figure && other !== neighbour; });
    // Beside each other in the order of the rows, whatever the page's.
    if (neighbour) figure.after(neighbour);
    slides.now = figure;
    range.max = Math.max(0, order.length - 1);
    range.value = order.indexOf(figure);
    for (const part of all("[data-key]")) {
      const isCurrent = part.dataset.key === figure?.dataset.key;
      part.classList.toggle("current", isCurrent);
      const box = isCurrent && part.closest("tr") ? part.closest(".tall") : null;
      // Its row is shown within the table; the page stays where it is.
      if (box && (part.offsetTop < box.scrollTop + 60 || part.offsetTop > box.scrollTop + box.clientHeight - 60)) {
        box.scrollTop = part.offsetTop - box.clientHeight / 2;
      }
    }
    slides.dispatchEvent(new Event("turned", { bubbles: true }));
  };
  const step = (by) => {
    const order = slides.order();
    slides.turnTo(order[(Number(range.value) + by + order.length) % order.length]);
  };
  document.addEventListener("rows", () => {
    const order = slides.order();
    slides.turnTo(order.includes(slides.now) ? slides.now : order[0]);
  });
  range.addEventListener("input", () => step(0));
  twin?.addEventListener("change", () => {
    slides.classList.toggle("twin", twin.checked);
    slides.turnTo(slides.now);
  });
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
