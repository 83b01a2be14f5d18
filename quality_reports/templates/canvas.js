// What the scripts of a subset's page share.
"use strict";
const tracklake = {
  make: (tag, properties, ...children) => {
    const made = Object.assign(document.createElement(tag), properties);
    made.append(...children);
    return made;
  },
  button: (label, title, act) => {
    const made = tracklake.make("button", { type: "button", textContent: label, title });
    made.addEventListener("click", act);
    return made;
  },
  clamp: (value, low, high) => Math.min(Math.max(value, low), high),
  unpack: (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)),
  readSpeed: (byte) => ((byte & 255) - 40) / 3.6,
  nameSpeed: (mps) => `${(mps * 3.6).toFixed(0)} km/h (${mps.toFixed(1)} m/s)`,
  // The least step of 1, 2 or 5 times a power of ten that is at least so many pixels wide.
  chooseStep: (scale, pixels) => {
    const least = pixels / scale;
    const power = 10 ** Math.floor(Math.log10(least));
    return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= least * 0.999);
  },
  // Fit a canvas to its size on the page, and return that in CSS pixels.
  fit: (canvas) => {
    const ratio = devicePixelRatio || 1;
    const size = [canvas.clientWidth, canvas.clientHeight];
    canvas.width = size[0] * ratio;
    canvas.height = size[1] * ratio;
    canvas.getContext("2d").setTransform(ratio, 0, 0, ratio, 0, 0);
    return size;
  },
  colour: (name) => getComputedStyle(document.documentElement).getPropertyValue(name),
};
