// Draws the time-space diagrams of a subset's page: tracks by lane, coloured by speed, to zoom and to move.
"use strict";
(() => {
  const { make, button, clamp, unpack, readSpeed, nameSpeed, chooseStep, fit, colour } = tracklake;
  const holder = document.querySelector(".diagrams");
  const data = JSON.parse(document.getElementById("tracks").textContent);

  // Data: segments by lane, the values of their points in shared arrays.
  const heads = new DataView(unpack(data.segments).buffer);
  const bytes = new Int8Array(unpack(data.points).buffer);
  const xs = new Float32Array(bytes.length / 2), speeds = new Float32Array(bytes.length / 2);
  const lanes = new Map();
  for (let at = 0, row = 0; at < heads.byteLength; at += 20) {
    const [lane, id, first, count, x0] = [0, 1, 2, 3, 4].map((place) => heads.getInt32(at + 4 * place, true));
    if (!lanes.has(lane)) lanes.set(lane, { lane, segments: [], marks: data.marks.filter((mark) => mark[0] === lane) });
    lanes.get(lane).segments.push({ id, first, last: first + count - 1, row });
    for (let end = row + count, x = x0; row < end; row += 1) {
      x += bytes[2 * row];
      xs[row] = x * data.unit_m;
      speeds[row] = readSpeed(bytes[2 * row + 1]);
    }
  }
  const diagrams = [...lanes.values()].sort((a, b) => (a.lane < 0) - (b.lane < 0) || a.lane - b.lane);
  const toTime = (tick) => data.zero_s + tick * data.seconds;
  const toTick = (time) => (time - data.zero_s) / data.seconds;

  // State: the shown stretch of time and of road, the same in all lanes.
  const LEFT = 46, RIGHT = 8, TOP = 8, BOTTOM = 24;
  const whole = { t: data.time_s, x: data.x_m };
  const shown = { t: [...whole.t], x: [...whole.x] };
  const least = { t: 20 * data.seconds, x: 20 };
  const move = (axis, by, factor = 1, about = 0.5) => {
    const [low, high] = shown[axis];
    const [first, last] = whole[axis];
    const span = clamp((high - low) * factor, Math.min(least[axis], last - first), last - first);
    const begin = clamp(low + (high - low - span) * about + by, first, last - span);
    shown[axis] = [begin, begin + span];
    redraw();
  };

  // Drawing.
  const measure = (canvas) => {
    const [w, h] = [canvas.clientWidth - LEFT - RIGHT, canvas.clientHeight - TOP - BOTTOM];
    const scaleT = w / (shown.t[1] - shown.t[0]), scaleX = h / (shown.x[1] - shown.x[0]);
    const placeT = (t) => LEFT + (t - shown.t[0]) * scaleT;
    const placeX = (x) => TOP + h - (x - shown.x[0]) * scaleX;
    return { w, h, scaleT, scaleX, placeT, placeX };
  };
  const crosses = (pen, points, tint, width) => {
    pen.beginPath();
    pen.strokeStyle = tint;
    pen.lineWidth = width;
    for (const [x, y] of points) {
      pen.moveTo(x - 3, y - 3);
      pen.lineTo(x + 3, y + 3);
      pen.moveTo(x - 3, y + 3);
      pen.lineTo(x + 3, y - 3);
    }
    pen.stroke();
  };
  const list = ({ marks }, scaleT, scaleX) => {
    const cells = new Map();  // one mark in every square of 30 pixels
    for (const mark of marks) {
      const [t, x] = [toTime(mark[1]), mark[2]];
      if (t < shown.t[0] || t > shown.t[1] || x < shown.x[0] || x > shown.x[1]) continue;
      const key = `${Math.floor(t * scaleT / 30)} ${Math.floor(x * scaleX / 30)}`;
      const cell = cells.get(key);
      if (cell) cell.findings += mark[3];
      else cells.set(key, { t, x, findings: mark[3], rule: mark[4], id: mark[5] });
    }
    return [...cells.values()];
  };
  const draw = (diagram) => {
    const { canvas, segments } = diagram;
    const pen = canvas.getContext("2d");
    const [width, height] = fit(canvas);
    const { w, h, scaleT, scaleX, placeT, placeX } = measure(canvas);
    if (w <= 0) return;
    const muted = colour("--muted");
    pen.clearRect(0, 0, width, height);
    pen.fillStyle = colour("--raster");
    pen.fillRect(LEFT, TOP, w, h);
    pen.font = "11px system-ui, sans-serif";
    pen.fillStyle = muted;
    pen.strokeStyle = "rgba(128, 136, 144, 0.35)";
    pen.lineWidth = 1;
    const stepT = chooseStep(scaleT, 80), stepX = chooseStep(scaleX, 50);
    pen.beginPath();
    pen.textAlign = "center";
    pen.textBaseline = "top";
    for (let t = Math.ceil(shown.t[0] / stepT) * stepT; t <= shown.t[1]; t += stepT) {
      pen.moveTo(placeT(t), TOP);
      pen.lineTo(placeT(t), TOP + h + 4);
      pen.fillText(`${+t.toFixed(3)} s`, Math.min(placeT(t), width - 20), TOP + h + 7);
    }
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    for (let x = Math.ceil(shown.x[0] / stepX) * stepX; x <= shown.x[1]; x += stepX) {
      pen.moveTo(LEFT - 4, placeX(x));
      pen.lineTo(LEFT + w, placeX(x));
      pen.fillText(`${+x.toFixed(3)} m`, LEFT - 7, placeX(x));
    }
    pen.stroke();
    pen.save();
    pen.beginPath();
    pen.rect(LEFT, TOP, w, h);
    pen.clip();
    // Tracks, one path per colour.
    const paths = data.colours.map(() => []);
    const [from, to] = [toTick(shown.t[0]), toTick(shown.t[1])];
    const levels = (data.colours.length - 1) / data.top_mps;
    const labels = [];
    for (const { id, first, last, row } of segments) {
      if (last < from || first > to) continue;
      const begin = Math.max(first, Math.floor(from)), end = Math.min(last, Math.ceil(to));
      for (let tick = begin; tick < end || tick === begin; tick += 1) {
        const at = row + tick - first, next = tick < last ? at + 1 : at;
        const level = Math.round(clamp((speeds[at] + speeds[next]) / 2 * levels, 0, data.colours.length - 1));
        const [t0, t1] = [placeT(toTime(tick)), placeT(toTime(next > at ? tick + 1 : tick))];
        paths[level].push(t0, placeX(xs[at]), next > at ? t1 : t0 + 1.5, placeX(xs[next]));
      }
      const middle = row + Math.floor((begin + end) / 2) - first;
      labels.push([id, placeT(toTime(Math.floor((begin + end) / 2))), placeX(xs[middle])]);
    }
    pen.lineWidth = clamp(scaleT / 6, 1.2, 2.5);
    paths.forEach((path, level) => {
      pen.strokeStyle = data.colours[level];
      pen.beginPath();
      for (let at = 0; at < path.length; at += 4) {
        pen.moveTo(path[at], path[at + 1]);
        pen.lineTo(path[at + 2], path[at + 3]);
      }
      pen.stroke();
    });
    if (labels.length * 30 < w) {
      pen.textAlign = "center";
      pen.lineWidth = 3;
      pen.strokeStyle = "#f8f9fa";
      pen.fillStyle = "#1f2328";
      const free = [];  // ids that are far enough from the ones before
      for (const label of labels) {
        if (free.some(([, across, down]) => Math.abs(across - label[1]) < 34 && Math.abs(down - label[2]) < 13)) continue;
        free.push(label);
        pen.strokeText(...label);
        pen.fillText(...label);
      }
    }
    diagram.marked = box.checked ? list(diagram, scaleT, scaleX).map((mark) => ({ ...mark, at: [placeT(mark.t), placeX(mark.x)] })) : [];
    const points = diagram.marked.map(({ at }) => at);
    crosses(pen, points, "#ffffff", 4);
    crosses(pen, points, "#000000", 1.6);
    pen.restore();
    diagram.stale = false;
  };
  const inView = ({ canvas }) => {
    const { top, bottom } = canvas.getBoundingClientRect();
    return bottom > -200 && top < innerHeight + 200;
  };
  let waiting = false;
  const drawStale = () => {
    waiting = false;
    diagrams.filter((diagram) => diagram.stale && inView(diagram)).forEach(draw);
  };
  const request = () => {
    if (!waiting) requestAnimationFrame(drawStale);
    waiting = true;
  };
  const redraw = () => {
    diagrams.forEach((diagram) => { diagram.stale = true; });
    const [t, x] = [shown.t, shown.x].map(([low, high]) => [low, high].map((value) => String(Math.round(value) || 0).replace("-", "\u2212")));
    stretch.textContent = `${t[0]} to ${t[1]} s, ${x[0]} to ${x[1]} m`;
    request();
  };

  // Acts.
  const say = (diagram, across, down) => {
    const { placeX, placeT, scaleT } = measure(diagram.canvas);
    const tick = toTick(shown.t[0] + (across - LEFT) / scaleT);
    let best = null;
    for (const { id, first, last, row } of diagram.segments) {
      if (tick < first - 1 || tick > last + 1) continue;
      const near = clamp(Math.round(tick), first, last);
      const at = row + near - first;
      const next = Math.min(at + 1, row + last - first);
      const share = clamp(tick - near, 0, 1);
      const apart = Math.hypot(placeX(xs[at] + (xs[next] - xs[at]) * share) - down, placeT(toTime(clamp(tick, first, last))) - across);
      if (apart < (best?.apart ?? 14)) best = { apart, text: `vehicle ${id} at ${toTime(near).toFixed(1)} s, ${xs[at].toFixed(0)} m: ${nameSpeed(speeds[at])}` };
    }
    const mark = diagram.marked.find(({ at }) => Math.hypot(at[0] - across, at[1] - down) < 9);
    const marked = mark ? `${mark.rule} of vehicle ${mark.id}${mark.findings > 1 ? ` and ${mark.findings - 1} more near here` : ""}` : "";
    hint.textContent = [marked, best?.text ?? ""].filter(Boolean).join("; ");
  };
  const keys = {
    "+": () => move("t", 0, 0.5), "=": () => move("t", 0, 0.5), "-": () => move("t", 0, 2), 0: () => showAll(),
    ArrowLeft: () => move("t", (shown.t[0] - shown.t[1]) / 5), ArrowRight: () => move("t", (shown.t[1] - shown.t[0]) / 5),
    ArrowUp: () => move("x", (shown.x[1] - shown.x[0]) / 5), ArrowDown: () => move("x", (shown.x[0] - shown.x[1]) / 5),
  };
  const showAll = () => {
    Object.assign(shown, { t: [...whole.t], x: [...whole.x] });
    redraw();
  };
  const listen = (diagram) => {
    const { canvas } = diagram;
    const share = (event) => {
      const { w, h } = measure(canvas);
      return [clamp((event.offsetX - LEFT) / w, 0, 1), clamp(1 - (event.offsetY - TOP) / h, 0, 1)];
    };
    let held = null;
    canvas.addEventListener("pointerdown", (event) => { held = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); });
    canvas.addEventListener("pointerup", () => { held = null; });
    canvas.addEventListener("pointercancel", () => { held = null; });
    canvas.addEventListener("pointermove", (event) => {
      if (diagram.stale && held === null) return;
      if (held === null) return say(diagram, event.offsetX, event.offsetY);
      const by = [held[0] - event.clientX, event.clientY - held[1]];
      held = [event.clientX, event.clientY];
      const { scaleT, scaleX } = measure(canvas);
      move("t", by[0] / scaleT);
      move("x", by[1] / scaleX);
    });
    canvas.addEventListener("dblclick", (event) => move("t", 0, 0.5, share(event)[0]));
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      const factor = 2 ** ((event.deltaY || event.deltaX) / 200);
      if (event.shiftKey) move("x", 0, factor, share(event)[1]);
      else move("t", 0, factor, share(event)[0]);
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      keys[event.key]();
    });
  };

  const stretch = make("output", {});
  const hint = make("p", { className: "note hint", role: "status", textContent: "" });
  const box = make("input", { type: "checkbox", checked: true });
  box.addEventListener("change", redraw);
  holder.append(make("div", { className: "tools" },
    make("div", { className: "controls" },
      make("span", { className: "note", textContent: "Time" }), button("\u2212", "Show more time (-)", () => move("t", 0, 2)), button("+", "Show less time (+)", () => move("t", 0, 0.5)),
      make("span", { className: "note", textContent: "Road" }), button("\u2212", "Show more of the road", () => move("x", 0, 2)), button("+", "Show less of the road", () => move("x", 0, 0.5)),
      button("All", "Show everything (0)", showAll), make("label", {}, box, " Marks"), stretch),
    hint));
  for (const diagram of diagrams) {
    const name = diagram.lane < 0 ? "Entries without a lane" : `Lane ${diagram.lane}`;
    diagram.canvas = make("canvas", { tabIndex: 0, ariaLabel: `Time-space diagram: ${name}` });
    diagram.canvas.setAttribute("role", "img");
    holder.append(make("figure", {}, make("figcaption", {}, make("strong", { textContent: name })), diagram.canvas));
    listen(diagram);
  }
  holder.hidden = false;
  // A narrow page begins with the first minutes, a second per pixel at most.
  const wide = holder.clientWidth - LEFT - RIGHT;
  if (wide > 0 && whole.t[1] - whole.t[0] > wide) shown.t = [whole.t[0], whole.t[0] + wide];
  redraw();
  addEventListener("scroll", request, { passive: true });
  addEventListener("beforeprint", () => diagrams.forEach(draw));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  new ResizeObserver(redraw).observe(holder);
})();
