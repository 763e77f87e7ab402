"use strict";
// Charts of the report: each figure gets a button, which puts a chart of its lines in place of the picture.
(() => {
  const GAP = 65535, LEVELS = 65534;

  function numbers(packed) {
    const bytes = Uint8Array.from(atob(packed.points), c => c.charCodeAt(0));
    const whole = new Uint16Array(bytes.buffer);
    const step = (packed.high - packed.low) / LEVELS;
    return Array.from(whole, n => n === GAP ? null : packed.low + step * n);
  }

  // A chart wants ascending places. A line keeps its gaps; dots have none.
  function table(series) {
    const at = numbers(series.at), value = numbers(series.value);
    let order = at.map((_, k) => k).filter(k => at[k] !== null);
    if (series.dots) order = order.filter(k => value[k] !== null);
    order.sort((a, b) => at[a] - at[b] || a - b);
    return [order.map(k => at[k]), order.map(k => value[k])];
  }

  const text = x => x == null ? "–" : Number(x.toPrecision(5)).toString();

  function chart(panel, width, height, sync) {
    // The places of other lines that lie in a gap of a line belong to the gap: mode 2.
    const data = uPlot.join(panel.series.map(table), panel.series.map(() => [0, 2]));
    const lines = panel.series.map(s => ({
      label: s.label || (s.dots ? "samples" : s.dashed ? "edge" : "line"), stroke: s.color, width: s.dots ? 0 : 1.5, dash: s.dashed ? [6, 4] : undefined,
      paths: s.dots ? () => null : undefined, points: { show: s.dots, size: 3, fill: s.color },
      value: (_, x) => text(x),
    }));
    const axis = (label, size) => ({ label, size, stroke: "#444", grid: { stroke: "#e6e6e6" } });
    return new uPlot({
      width, height, cursor: { sync: { key: sync }, drag: { x: true, y: false } },
      scales: { x: { time: false } },
      axes: [axis(panel.x, 46), axis(panel.y, 70)],
      series: [{ label: panel.x || "x", value: (_, x) => text(x) }, ...lines],
    }, data, document.createElement("div"));
  }

  document.querySelectorAll(".zoom").forEach((place, k) => {
    const panels = JSON.parse(place.dataset.charts);
    const picture = place.parentElement.querySelector("picture");
    const button = document.createElement("button");
    const charts = document.createElement("div");
    const hint = document.createElement("p");
    const words = ["Zoom and read values", "Back to the picture"];
    let made = [];
    hint.className = "small";
    hint.textContent = "Drag over a range to see it, double-click for all of it. The values under the pointer stand below.";
    button.type = "button";
    button.textContent = words[0];
    charts.hidden = hint.hidden = true;
    place.append(button, hint, charts);
    place.hidden = false;

    const fit = () => Math.max(240, Math.floor(place.clientWidth));
    button.addEventListener("click", () => {
      const open = charts.hidden;
      charts.hidden = hint.hidden = !open;
      picture.classList.toggle("replaced", open);
      button.textContent = words[open ? 1 : 0];
      if (open && !made.length) {
        made = panels.map(panel => chart(panel, fit(), panels.length > 1 ? 260 : 340, "figure " + k));
        charts.append(...made.map(c => c.root));
      }
    });
    addEventListener("resize", () => made.forEach(c => c.setSize({ width: fit(), height: c.height })));
  });
})();
