/* A line chart: series = [{name, points: [[x, y], ...]}]; logarithmic where asked for. */
"use strict";
function plot(title, series, logarithmic) {
  const W = 420, H = 180, L = 56, B = 24, T = 24, R = 110, NS = "http://www.w3.org/2000/svg";
  const kept = series.map(function (s) {
    return { name: s.name, points: s.points.filter(function (p) { return isFinite(p[1]) && (!logarithmic || p[1] > 0); }) };
  }).filter(function (s) { return s.points.length; });
  function make(name, attributes, text) {
    const node = document.createElementNS(NS, name);
    Object.keys(attributes).forEach(function (key) { node.setAttribute(key, attributes[key]); });
    if (text !== undefined) node.textContent = text;
    return node;
  }
  const svg = make("svg", { viewBox: "0 0 " + W + " " + H, class: "chart", role: "img", "aria-label": title });
  svg.appendChild(make("text", { x: L, y: 14 }, title));
  if (!kept.length) return svg;
  const scale = logarithmic ? Math.log10 : function (v) { return v; };
  const all = [].concat.apply([], kept.map(function (s) { return s.points; }));
  const xs = all.map(function (p) { return p[0]; }), ys = all.map(function (p) { return scale(p[1]); });
  const x0 = Math.min.apply(null, xs), x1 = Math.max(Math.max.apply(null, xs), x0 + 1);
  let y0 = Math.min.apply(null, ys), y1 = Math.max.apply(null, ys);
  if (y1 - y0 < 1e-9) { y0 -= 0.5; y1 += 0.5; }
  function short(v) { return v !== 0 && Math.abs(v) < 0.01 ? v.toExponential(1) : v.toPrecision(3); }
  function px(x) { return L + (x - x0) / (x1 - x0) * (W - L - R); }
  function py(y) { return H - B - (scale(y) - y0) / (y1 - y0) * (H - B - T); }
  [0, 0.5, 1].forEach(function (t) {
    const y = H - B - t * (H - B - T), value = logarithmic ? Math.pow(10, y0 + t * (y1 - y0)) : y0 + t * (y1 - y0);
    svg.appendChild(make("line", { x1: L, x2: W - R, y1: y, y2: y, class: "grid" }));
    svg.appendChild(make("text", { x: L - 6, y: y + 4, "text-anchor": "end", class: "tick" }, short(value)));
  });
  [x0, x1].forEach(function (x, i) {
    svg.appendChild(make("text", { x: px(x), y: H - 6, "text-anchor": i ? "end" : "start", class: "tick" }, (i ? "epoch " : "") + x));
  });
  kept.forEach(function (s, i) {
    const points = s.points.map(function (p) { return px(p[0]).toFixed(1) + "," + py(p[1]).toFixed(1); }).join(" ");
    svg.appendChild(make("polyline", { points: points, class: "s" + i % 7 }));
    svg.appendChild(make("text", { x: W - R + 8, y: T + 10 + 15 * i, class: "f" + i % 7 }, s.name));
  });
  return svg;
}
