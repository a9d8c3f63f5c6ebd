"use strict";
// One cursor over all charts: the values at its time in the legends, and the place on the map.
const data = JSON.parse(document.getElementById("data").textContent);
const svgs = [...document.querySelectorAll("svg.time")];
const map = document.querySelector("svg.map");

function before(times, t) {
  let low = 0, high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t) low = middle + 1; else high = middle;
  }
  return low - 1;
}

function show(t) {
  const x = data.left + (t - data.begin) / (data.end - data.begin) * (data.width - data.left - data.right);
  for (const svg of svgs) {
    const cursor = svg.querySelector(".cursor");
    cursor.setAttribute("x1", x);
    cursor.setAttribute("x2", x);
    cursor.setAttribute("visibility", "visible");
  }
  for (const [name, series] of Object.entries(data.charts)) {
    const values = document.querySelectorAll(`[data-chart="${name}"] b`);
    series.forEach(([times, numbers], number) => {
      const at = before(times, t);
      const value = at < 0 ? null : numbers[at];
      values[number].textContent = value === null ? "" : " " + String(Number(value.toPrecision(4))).replace("-", "−");
    });
  }
  document.querySelectorAll(".now").forEach(element => { element.textContent = `${t.toFixed(2)} s`; });
  if (map && data.way) {
    const at = Math.max(0, before(data.way[0], t));
    const half = Number(map.dataset.half), inner = Number(map.dataset.inner), here = map.querySelector(".here");
    here.setAttribute("cx", Number(map.dataset.left) + (data.way[1][at] - map.dataset.cx + half) / (2 * half) * inner);
    here.setAttribute("cy", inner - (data.way[2][at] - map.dataset.cy + half) / (2 * half) * inner + 2);
    here.setAttribute("visibility", "visible");
  }
}

for (const svg of svgs) {
  svg.addEventListener("pointermove", event => {
    const box = svg.getBoundingClientRect();
    const x = (event.clientX - box.left) / box.width * data.width;
    const share = (x - data.left) / (data.width - data.left - data.right);
    show(data.begin + Math.min(1, Math.max(0, share)) * (data.end - data.begin));
  });
}
