"use strict";
{ // names of its own, beside those of page.js
  // What lies over the photos is shown or hidden in all of them; the viewer's copy follows.
  const toggles = all("input[data-layer]");
  const layer = () => {
    for (const toggle of toggles) {
      for (const image of all(`img[data-layer="${toggle.dataset.layer}"]`)) image.hidden = !toggle.checked;
    }
  };
  for (const toggle of toggles) toggle.addEventListener("change", layer);
  layer();

  // Leads to the picture as its row does; to the row alone where a filter hides it.
  for (const link of all("a[data-photo]")) {
    link.addEventListener("click", (event) => {
      if (document.getElementById("furthest").hidden) return;
      event.preventDefault();
      open(link.dataset.photo);
    });
  }

  // Tags by photo. The page has those of the file beside it; the browser remembers what changes, and an
  // export writes all of them, those of photos that are not on this page too.
  const section = document.querySelector("section.pair");
  const given = JSON.parse(document.getElementById("tags").textContent);
  const state = section.querySelector(".state");
  const entry = section.querySelector(".tagging input");
  const place = `lodbench tags ${given.of}`;
  const plain = (word) => word.trim().replace(/\s+/g, " ").slice(0, 60);
  const listed = (tags) => Object.fromEntries(
    [...tags].filter(([, words]) => words.size).sort(([a], [b]) => (a < b ? -1 : 1)).map(([key, words]) => [key, [...words].sort()]));
  const fixed = (tags) => JSON.stringify(Object.entries(listed(tags)));
  const mapped = (values) => new Map(Object.entries(values).map(([key, words]) => [key, new Set(words.map(plain).filter(Boolean))]));
  // Tags as a file has them, or null for what is none.
  const readTags = (text) => {
    try {
      const values = JSON.parse(text).tags;
      const isRight = values && typeof values === "object" && !Array.isArray(values)
        && Object.values(values).every((words) => Array.isArray(words) && words.every((word) => typeof word === "string"));
      return isRight ? mapped(values) : null;
    } catch {
      return null;
    }
  };
  // Adds tags to others; returns to how many photos.
  const join = (tags, more) => {
    let count = 0;
    for (const [key, words] of more) {
      const mine = tags.get(key) ?? new Set();
      const before = mine.size;
      for (const word of words) mine.add(word);
      tags.set(key, mine);
      count += mine.size > before ? 1 : 0;
    }
    return count;
  };
  const base = fixed(mapped(given.tags));
  let tags = mapped(given.tags);
  let exported = base;
  let isKept = true;
  const keep = () => {
    try {
      localStorage.setItem(place, JSON.stringify({ base, exported, tags: listed(tags) }));
      isKept = true;
    } catch {
      isKept = false;
    }
  };
  const remembered = () => {
    try {
      const kept = JSON.parse(localStorage.getItem(place) ?? "null");
      return kept && { ...kept, tags: readTags(JSON.stringify(kept)) };
    } catch {
      return null;
    }
  };
  const many = (count) => `${count} photo${count === 1 ? "" : "s"}`;
  const say = (words = "") => {
    const tagged = [...tags.values()].filter((mine) => mine.size).length;
    const rest = fixed(tags) === exported ? "" : isKept ? ", not exported yet" : ", NOT kept by this browser: export before you close the page";
    state.textContent = `${words}${words ? ". " : ""}${many(tagged)} tagged${rest}.`;
  };
  const current = () => section.querySelector(".slides figure:not([hidden])")?.dataset.key;
  const chip = (word, kind) => Object.assign(document.createElement(kind), { className: "tag", textContent: word });
  const chips = () => {
    const key = current();
    section.querySelector(".chips").replaceChildren(...[...(tags.get(key) ?? [])].sort().map((word) => {
      const button = chip(word, "button");
      button.type = "button";
      button.setAttribute("aria-label", `remove tag ${word}`);
      button.append(" \u00d7");
      button.addEventListener("click", () => change([key], word, false));
      return button;
    }));
  };
  const fill = () => {
    for (const row of all("tr[data-key]", section)) {
      const mine = [...(tags.get(row.dataset.key) ?? [])].sort();
      row.querySelector(".tags").replaceChildren(...mine.map((word) => chip(word, "span")));
    }
    const known = [...new Set([...tags.values()].flatMap((mine) => [...mine]))].sort();
    const option = (value, text) => Object.assign(document.createElement("option"), { value, textContent: text });
    section.querySelector("#known-tags").replaceChildren(...known.map((word) => option(word, word)));
    const select = section.querySelector("select.tagged");
    const chosen = select.value;
    // A word begins with = so that none is taken for a choice of the page's own.
    select.replaceChildren(option("", "any"), option("-", "without tag"), ...known.map((word) => option(`=${word}`, word)));
    select.value = [...select.options].some((each) => each.value === chosen) ? chosen : "";
    chips();
  };
  const changed = (words) => {
    keep();
    fill();
    section.querySelector("input.filter").dispatchEvent(new Event("input"));
    say(words);
  };
  const change = (keys, word, isAdded) => {
    if (!word) {
      say("Type a tag first");
      return;
    }
    for (const key of keys) {
      const mine = tags.get(key) ?? new Set();
      if (isAdded) mine.add(word);
      else mine.delete(word);
      tags.set(key, mine);
    }
    changed(`${isAdded ? "Tagged" : "Untagged"} ${many(keys.length)}: ${word}`);
  };
  const shownKeys = () => all("tbody tr[data-key]", section).filter((row) => !row.hidden).map((row) => row.dataset.key);
  section.querySelector(".tagging").addEventListener("submit", (event) => {
    event.preventDefault();
    const key = current();
    if (key) change([key], plain(entry.value), true);
    if (key) entry.value = "";
  });
  section.querySelector(".tag-shown").addEventListener("click", () => change(shownKeys(), plain(entry.value), true));
  section.querySelector(".untag-shown").addEventListener("click", () => change(shownKeys(), plain(entry.value), false));
  section.querySelector(".export").addEventListener("click", () => {
    const content = { format: "lodbench photo tags 1", dataset: given.dataset, version: given.version, tags: listed(tags) };
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([`${JSON.stringify(content, null, 1)}\n`], { type: "application/json" }));
    link.download = given.file;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    exported = fixed(tags);
    keep();
    say(`Exported as ${given.file}`);
  });
  section.querySelector(".import").addEventListener("change", async (event) => {
    const [file] = event.target.files;
    if (!file) return;
    const more = readTags(await file.text());
    event.target.value = "";
    if (!more) say(`${file.name} holds no tags`);
    else changed(`${file.name}: new tags for ${many(join(tags, more))}`);
  });
  section.querySelector(".clear").addEventListener("click", () => {
    for (const input of all(".filters input, .filters select", section)) input.value = "";
    section.querySelector("input.filter").dispatchEvent(new Event("input"));
  });
  addEventListener("beforeunload", (event) => {
    if (!isKept && fixed(tags) !== exported) event.preventDefault();
  });
  section.addEventListener("turned", chips);
  const kept = remembered();
  let first = "";
  if (kept?.tags) {
    if (kept.base === base) {
      tags = kept.tags;
      exported = kept.exported;
    } else {
      // The file is another now: nothing that either has is lost.
      const count = join(tags, kept.tags);
      if (count) first = `Tags that this browser kept were added to those of ${given.file}, for ${many(count)}`;
    }
  }
  fill();
  say(first);
}
