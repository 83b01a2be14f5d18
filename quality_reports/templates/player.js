// Plays the scenes of a subset's page on a canvas: lanes, vehicles as boxes, their ids, colour by speed.
"use strict";
(() => {
  const player = document.querySelector(".player");
  const scene = JSON.parse(document.getElementById("scene").textContent);
  const { make, button, clamp, unpack, readSpeed, nameSpeed, chooseStep, fit, colour } = tracklake;

  // Data: segments with positions per tick, and ticks counted without the gaps between stretches.
  const heads = new DataView(unpack(scene.segments).buffer);
  const bytes = new Int8Array(unpack(scene.entries).buffer);
  const segments = [];
  for (let at = 0, row = 0; at < heads.byteLength; at += 28) {
    const [id, first, count, x0, y0, length, width] = [0, 1, 2, 3, 4, 5, 6].map((place) => heads.getInt32(at + 4 * place, true));
    const segment = { id, first, last: first + count - 1, length: length / 10, width: width / 10, x: [], y: [], speed: [], heading: [] };
    for (let step = 0, x = x0, y = y0; step < count; step += 1, row += 4) {
      x += bytes[row];
      y += bytes[row + 1];
      segment.x.push(x / 10);
      segment.y.push(y / 100);
      segment.speed.push(readSpeed(bytes[row + 2]));
      segment.heading.push(bytes[row + 3] / 75);
    }
    segments.push(segment);
  }
  let total = 0;
  const stretches = scene.stretches.map(([first, last]) => {
    const stretch = { first, last, place: total };
    total += last - first + 1;
    return stretch;
  });
  const holds = (tick) => stretches.find(({ first, last }) => first <= tick && tick < last + 1);
  const toPlace = (tick) => { const stretch = holds(tick) ?? stretches[0]; return stretch.place + tick - stretch.first; };
  const toTick = (place) => {
    const stretch = stretches.findLast((each) => each.place <= place) ?? stretches[0];
    return Math.min(stretch.first + place - stretch.place, stretch.last + 0.999);
  };

  // State.
  const road = { left: Math.min(...scene.x_m) - 15, right: Math.max(...scene.x_m) + 5 };
  const edges = scene.markings ?? [scene.y_m[0] - 2, scene.y_m[1] + 2];
  const top = Math.min(edges[0], scene.y_m[0]) - 3;
  const bottom = Math.max(edges.at(-1), scene.y_m[1]) + 3;
  const state = { tick: stretches[0].first, until: null, playing: false, rate: 1, finding: null, middle: 0, span: 0 };
  const canvas = make("canvas", { tabIndex: 0, ariaLabel: "Vehicles from above. Space plays, arrows step." });
  canvas.setAttribute("role", "img");
  const pen = canvas.getContext("2d");

  // Drawing.
  let scale, tall, origin, size;
  const measure = () => { size = fit(canvas); };
  const toX = (x) => size[0] / 2 + (x - state.middle) * scale;
  const toY = (y) => origin + (y - top) * tall;
  const place = (values, at, share) => (at + 1 < values.length ? values[at] + (values[at + 1] - values[at]) * share : values[at]);
  const list = () => {
    const tick = Math.floor(state.tick + 1e-6);
    const share = clamp(state.tick - tick, 0, 1);
    return segments.filter(({ first, last }) => first <= tick && tick <= last).map((segment) => {
      const at = tick - segment.first;
      const read = (name) => place(segment[name], at, share);
      return { ...segment, x: read("x"), y: read("y"), speed: read("speed"), heading: read("heading") };
    });
  };
  const focused = () => state.finding?.vehicles ?? [];
  const follow = (vehicles) => {
    const own = vehicles.filter(({ id }) => focused().includes(id));
    if (state.following && own.length) {
      const [low, high] = [Math.min(...own.map(({ x, length }) => x - length)), Math.max(...own.map(({ x }) => x))];
      state.middle = (low + high) / 2;
    }
  };
  const line = (from, to, colour, dash, width = 1) => {
    pen.beginPath();
    pen.setLineDash(dash);
    pen.lineWidth = width;
    pen.strokeStyle = colour;
    pen.moveTo(...from);
    pen.lineTo(...to);
    pen.stroke();
    pen.setLineDash([]);
  };
  const drawRoad = () => {
    const muted = colour("--muted");
    pen.fillStyle = colour("--panel");
    pen.fillRect(0, 0, ...size);
    pen.fillStyle = "#f4f6f8";  // light in the dark, too: dark purple must stay visible
    pen.fillRect(0, toY(edges[0]), size[0], toY(edges.at(-1)) - toY(edges[0]));
    (scene.markings ?? []).forEach((y, number, all) => {
      const edge = number === 0 || number === all.length - 1;
      line([0, toY(y)], [size[0], toY(y)], "#68727c", edge ? [] : [10, 12], edge ? 2 : 1.5);
    });
    pen.font = "11px system-ui, sans-serif";
    pen.textBaseline = "middle";
    for (const [lane, middle] of scene.lanes) {
      const y = toY(middle);
      if (!scene.markings) line([0, y], [size[0], y], "#b4bcc4", [2, 6]);
      pen.fillStyle = "#4b545d";
      pen.textAlign = "left";
      pen.fillText(`lane ${lane}`, 4, y);
    }
    const step = chooseStep(scale, 70);
    pen.textAlign = "center";
    for (let x = Math.ceil((state.middle - state.span / 2) / step) * step; toX(x) < size[0]; x += step) {
      line([toX(x), size[1] - 20], [toX(x), size[1] - 15], muted, []);
      pen.fillStyle = muted;
      pen.fillText(`${x} m`, toX(x), size[1] - 8);
    }
  };
  const drawVehicle = ({ id, x, y, length, width, speed, heading }) => {
    const own = focused().includes(id);
    const [cos, sin] = [Math.cos(heading), Math.sin(heading)];
    const corner = (back, right) => [toX(x - back * cos - right * sin), toY(y - back * sin + right * cos)];
    pen.beginPath();
    pen.moveTo(...corner(0, -width / 2));
    pen.lineTo(...corner(0, width / 2));
    pen.lineTo(...corner(length, width / 2));
    pen.lineTo(...corner(length, -width / 2));
    pen.closePath();
    const level = clamp(speed / scene.top_mps, 0, 1) * (scene.colours.length - 1);
    pen.fillStyle = scene.colours[Math.round(level)];
    pen.globalAlpha = own ? 0.75 : 1;
    pen.fill();
    pen.globalAlpha = 1;
    pen.lineWidth = own ? 3 : 1;
    pen.strokeStyle = own ? "#d55e00" : "#1f2328";
    pen.stroke();
    line(corner(Math.min(1.2, length / 3), -width / 2), corner(Math.min(1.2, length / 3), width / 2), "#1f2328", []);
    if (own || scale >= 3) {
      const [across, down] = corner(length / 2, 0);
      const above = focused().indexOf(id) !== 1;
      pen.font = `${own ? "bold 13" : "11"}px system-ui, sans-serif`;
      pen.textAlign = "center";
      pen.lineWidth = 3;
      pen.strokeStyle = "#f8f9fa";
      const height = down + (above ? -1 : 1) * (width * tall / 2 + 9);
      pen.strokeText(id, across, height);
      pen.fillStyle = "#1f2328";
      pen.fillText(id, across, height);
    }
  };
  const time = make("output", {});
  const report = make("p", { className: "note" });
  const scrubber = make("input", { type: "range", min: 0, max: Math.max(0, total - 1), step: 1, ariaLabel: "Time" });
  const describe = (vehicles) => focused().map((id) => {
    const vehicle = vehicles.find((each) => each.id === id);
    if (!vehicle) return `vehicle ${id}: not on the road`;
    const inView = toX(vehicle.x) >= 0 && toX(vehicle.x - vehicle.length) <= size[0];
    return `vehicle ${id}: ${nameSpeed(vehicle.speed)} at ${vehicle.x.toFixed(0)} m`
      + (inView ? "" : ", out of view");
  });
  const draw = () => {
    if (!size?.[0]) return;
    const vehicles = list();
    follow(vehicles);
    scale = size[0] / state.span;
    tall = Math.min((size[1] - 34) / (bottom - top), Math.max(scale, Math.min(scale * 4, 12)));
    origin = (size[1] - 24 - (bottom - top) * tall) / 2;
    drawRoad();
    vehicles.sort((a, b) => focused().includes(a.id) - focused().includes(b.id)).forEach(drawVehicle);
    time.textContent = `${(scene.zero_s + state.tick * scene.seconds).toFixed(1)} s`;
    scrubber.value = Math.floor(toPlace(state.tick));
    const { finding } = state;
    const now = finding && Math.floor(state.tick) >= Math.floor(finding.begins) && state.tick <= finding.ends + 1;
    report.textContent = finding
      ? `${finding.rule}${now ? " now" : ""}; ${describe(vehicles).join("; ")}`
      : `${vehicles.length} vehicles on the road`;
  };

  // Acts.
  const showPlaying = () => { play.textContent = state.playing ? "Pause" : "Play"; };
  const pause = () => { state.playing = false; showPlaying(); };
  const go = (tick, until = null) => { state.tick = tick; state.until = until; draw(); };
  const step = (ticks) => { pause(); go(toTick(clamp(Math.round(toPlace(state.tick)) + ticks, 0, total - 1))); };
  const advance = (ticks) => {
    const before = holds(state.tick);
    let tick = state.tick + ticks;
    const end = state.until ?? before.last;
    if (tick >= end) {
      const next = state.until === null && stretches[stretches.indexOf(before) + 1];
      tick = next ? next.first : end;
      if (!next) pause();
    }
    state.tick = tick;
    draw();
  };
  let last = 0;
  const run = (now) => {
    if (!state.playing) return;
    advance(Math.min((now - last) / 1000, 0.2) * state.rate / scene.seconds);
    last = now;
    requestAnimationFrame(run);
  };
  const start = () => {
    if (state.tick >= (state.until ?? stretches.at(-1).last)) state.tick = state.until === null ? stretches[0].first : state.finding.from;
    state.playing = true;
    showPlaying();
    last = performance.now();
    requestAnimationFrame(run);
  };
  const play = button("Play", "Play or pause (space)", () => (state.playing ? pause() : start()));
  const zoom = (factor) => { state.span = clamp(state.span * factor, 20, road.right - road.left); draw(); };
  const showAll = () => {
    Object.assign(state, { following: false, middle: (road.left + road.right) / 2, span: road.right - road.left });
    draw();
  };
  const choice = make("select", { ariaLabel: "Finding" }, make("option", { value: "", textContent: "no finding" }),
    ...scene.findings.map(({ number, rule, vehicles }) => make("option", {
      value: number, textContent: `${rule}, vehicle${vehicles.length > 1 ? "s" : ""} ${vehicles.join(" and ")}`,
    })));
  const watch = (number) => {
    const finding = scene.findings.find((each) => each.number === Number(number));
    state.finding = finding ?? null;
    choice.value = finding ? number : "";
    if (!finding) return draw();
    Object.assign(state, { following: true, span: clamp(size[0] / 10, 30, 110), middle: state.middle });
    go(finding.from, finding.to);
    const [at] = segments.filter(({ id, first: begin, last: end }) => id === finding.vehicles[0] && end >= finding.from && begin <= finding.to);
    if (at && !list().some(({ id }) => id === at.id)) { state.middle = at.x[0]; draw(); }
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches && !state.playing) start();
  };
  const skip = (by) => {
    const at = scene.findings.indexOf(state.finding);
    const next = scene.findings[clamp(at + by, 0, scene.findings.length - 1)];
    if (next) watch(next.number);
  };
  choice.addEventListener("change", () => watch(choice.value === "" ? NaN : choice.value));
  scrubber.addEventListener("input", () => { pause(); go(toTick(Number(scrubber.value))); });
  const speeds = make("select", { ariaLabel: "Speed of playing" }, ...[0.25, 0.5, 1, 2, 5].map((rate) => make("option", {
    value: rate, textContent: `${rate} ×`, selected: rate === 1,
  })));
  speeds.addEventListener("change", () => { state.rate = Number(speeds.value); });
  const keys = {
    " ": () => play.click(), ArrowLeft: () => step(-1), ArrowRight: () => step(1), Home: () => step(-total), End: () => step(total),
    "+": () => zoom(0.7), "=": () => zoom(0.7), "-": () => zoom(1 / 0.7), 0: showAll, n: () => skip(1), p: () => skip(-1),
  };
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    keys[event.key]();
  });
  let held = null;
  canvas.addEventListener("pointerdown", (event) => { held = event.clientX; canvas.setPointerCapture(event.pointerId); });
  canvas.addEventListener("pointerup", () => { held = null; });
  canvas.addEventListener("pointermove", (event) => {
    if (held === null) return;
    state.following = false;
    state.middle = clamp(state.middle - (event.clientX - held) / scale, road.left, road.right);
    held = event.clientX;
    draw();
  });
  document.querySelectorAll("[data-finding]").forEach((link) => {
    link.hidden = false;
    link.addEventListener("click", () => {
      document.getElementById("player").scrollIntoView();
      canvas.focus({ preventScroll: true });
      watch(link.dataset.finding);
    });
  });

  const ramp = make("span", { className: "ramp" });
  ramp.style.background = `linear-gradient(to right, ${scene.colours.join(",")})`;
  player.append(
    canvas,
    make("div", { className: "controls" }, scrubber, play, button("\u2039", "One step back (left arrow)", () => step(-1)),
      button("\u203a", "One step on (right arrow)", () => step(1)), time, speeds, choice,
      button("Previous", "Previous finding (p)", () => skip(-1)), button("Next", "Next finding (n)", () => skip(1)),
      button("\u2212", "Show more of the road (-)", () => zoom(1 / 0.7)), button("+", "Show less of the road (+)", () => zoom(0.7)),
      button("Whole road", "Show the whole road (0)", showAll)),
    report,
    make("p", { className: "note" }, "0", ramp,
      `${nameSpeed(scene.top_mps)}. Drag to move along the road. Keys: space, arrows, Home, End, + and −, `
      + "0 (whole road), n and p (findings)." + (scene.markings ? "" : " Markings are unknown: dotted lines are the median positions in each lane.")),
  );
  player.hidden = false;
  measure();
  showAll();
  if (size[0] < 700) zoom(clamp(250 / state.span, 0.1, 1));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  new ResizeObserver(() => { measure(); draw(); }).observe(canvas);
})();
