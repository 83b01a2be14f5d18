// Folds sections, and sorts and filters tables. Without it the page shows everything; on paper everything is open.
"use strict";
(() => {
  const find = (selector, within = document) => [...within.querySelectorAll(selector)];
  const make = (tag, properties, ...children) => {
    const made = Object.assign(document.createElement(tag), properties);
    made.append(...children);
    return made;
  };

  // Sections.
  const folds = find("details");
  find("details[data-folded]").forEach((fold) => { fold.open = false; });
  const show = (hash) => {
    const target = hash.length > 1 && document.getElementById(decodeURIComponent(hash.slice(1)));
    if (!target) return;
    for (let at = target.querySelector("details") ?? target; at; at = at.parentElement) {
      if (at.tagName === "DETAILS") at.open = true;
    }
    target.scrollIntoView();
  };
  document.addEventListener("click", (event) => {
    const link = event.target.closest?.('a[href^="#"]');
    if (link && link.hash === location.hash) show(link.hash);
  });
  addEventListener("hashchange", () => show(location.hash));
  show(location.hash);
  let closed = [];
  addEventListener("beforeprint", () => {
    closed = folds.filter((fold) => !fold.open);
    closed.forEach((fold) => { fold.open = true; });
  });
  addEventListener("afterprint", () => closed.forEach((fold) => { fold.open = false; }));
  const contents = document.querySelector("nav");
  if (contents && find("details[data-folded]").length > 1) {
    const all = make("button", { type: "button", textContent: "Open all" });
    all.addEventListener("click", () => {
      const open = all.textContent === "Open all";
      folds.forEach((fold) => { fold.open = open; });
      all.textContent = open ? "Fold all" : "Open all";
    });
    contents.append(all);
  }

  // Tables.
  const fit = new ResizeObserver((entries) => entries.forEach(({ target }) => {
    target.classList.toggle("fits", target.scrollWidth <= target.clientWidth);
  }));
  find(".box").forEach((box) => fit.observe(box));
  const listHeads = (table) => {
    const grid = [];
    [...table.tHead.rows].forEach((row, y) => {
      let x = 0;
      for (const cell of row.cells) {
        while (grid[y]?.[x]) x += 1;
        for (let down = 0; down < cell.rowSpan; down += 1) {
          for (let right = 0; right < cell.colSpan; right += 1) (grid[y + down] ??= [])[x + right] = cell;
        }
      }
    });
    return grid.at(-1) ?? [];
  };
  const read = (cell) => {
    const text = cell?.textContent.trim() ?? "";
    if (text === "" || text === "\u2013") return null;
    return cell.classList.contains("n") ? parseFloat(text.replace(/[,<+]/g, "").replace("\u2212", "-")) : text;
  };
  const compare = (a, b) => (typeof a === "number" ? a - b : a.localeCompare(b, "en", { numeric: true }));
  const listGroups = (body) => {
    const groups = [];  // sums stay first, and rows that follow another one stay with it
    for (const row of body.rows) {
      if (row.classList.contains("follows") && groups.length) groups.at(-1).push(row);
      else groups.push([row]);
    }
    return groups;
  };
  const sort = (table, head, column) => {
    const down = head.ariaSort === "none" ? head.classList.contains("n") : head.ariaSort === "ascending";
    find("[aria-sort]", table).forEach((other) => { other.ariaSort = "none"; });
    head.ariaSort = down ? "descending" : "ascending";
    const body = table.tBodies[0];
    const groups = listGroups(body).map((rows) => ({ rows, value: read(rows[0].cells[column]) }));
    const isSum = ({ rows }) => rows[0].classList.contains("sum");
    const known = groups.filter((group) => !isSum(group) && group.value !== null);
    known.sort((a, b) => (down ? compare(b.value, a.value) : compare(a.value, b.value)));
    const unknown = groups.filter((group) => !isSum(group) && group.value === null);
    body.append(...[...groups.filter(isSum), ...known, ...unknown].flatMap(({ rows }) => rows));
  };
  const filter = (table, words, count) => {
    const groups = listGroups(table.tBodies[0]);
    let shown = 0;
    for (const rows of groups) {
      const text = rows.map((row) => row.textContent).join(" ").toLowerCase();
      const hidden = !words.every((word) => text.includes(word));
      rows.forEach((row) => { row.hidden = hidden; });
      shown += hidden ? 0 : 1;
    }
    count.textContent = words.length ? `${shown} of ${groups.length} rows` : "";
  };
  for (const table of find(".box > table")) {
    if (!table.tHead || table.tBodies[0].rows.length < 3) continue;
    listHeads(table).forEach((head, column) => {
      const button = make("button", { type: "button", title: "Sort by this column" }, ...head.childNodes);
      button.addEventListener("click", () => sort(table, head, column));
      head.ariaSort = "none";
      head.append(button);
    });
    if (table.tBodies[0].rows.length > 12) {
      const count = make("span", { className: "note", role: "status" });
      const input = make("input", { type: "search", placeholder: "Filter rows", ariaLabel: "Filter the rows of the table" });
      input.addEventListener("input", () => filter(table, input.value.toLowerCase().split(/\s+/).filter(Boolean), count));
      table.parentElement.before(make("div", { className: "filter" }, input, count));
    }
  }
})();
