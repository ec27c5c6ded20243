/* The turning sphere: same projection as sphere.py's oblique one, with the eye's angles from the mouse. */
function turnSphere(svg) {
  "use strict";
  var eye = svg.parentElement.dataset.eye.split(" ").map(Number), az = eye[0], el = eye[1];
  var half = svg.viewBox.baseVal.width / 2, unit = Number(svg.querySelector(".globe").getAttribute("r"));
  var marks = Array.from(svg.querySelectorAll("[data-p]"), function (node) {
    return { node: node, p: node.dataset.p.split(" ").map(Number) };
  });
  function project(p) {
    var ca = Math.cos(az), sa = Math.sin(az), ce = Math.cos(el), se = Math.sin(el), along = ca * p[0] + sa * p[1];
    return [-sa * p[0] + ca * p[1], -se * along + ce * p[2], ce * along + se * p[2]];
  }
  function draw() {
    marks.forEach(function (m) { m.q = project(m.p); });
    marks.forEach(function (m) {
      var x = m.q[0], y = m.q[1];
      if (m.node.classList.contains("axis3")) {
        var line = m.node.querySelector("line"), text = m.node.querySelector("text");
        line.setAttribute("x2", half + x * unit); line.setAttribute("y2", half - y * unit);
        text.setAttribute("x", half + x * (unit + 16)); text.setAttribute("y", half - y * (unit + 16) + 4);
      } else {
        m.node.setAttribute("transform", "translate(" + (half + x * unit).toFixed(1) + " " + (half - y * unit).toFixed(1) + ")");
        m.node.classList.toggle("far", m.q[2] < 0);
      }
    });
    marks.filter(function (m) { return m.node.classList.contains("view"); })
      .sort(function (a, b) { return a.q[2] - b.q[2]; })
      .forEach(function (m) { svg.appendChild(m.node); });
  }
  var start = null;
  svg.addEventListener("pointerdown", function (e) { start = [e.clientX, e.clientY, az, el]; svg.setPointerCapture(e.pointerId); });
  svg.addEventListener("pointermove", function (e) {
    if (!start) return;
    az = start[2] - (e.clientX - start[0]) * 0.01;
    el = Math.max(-1.5, Math.min(1.5, start[3] + (e.clientY - start[1]) * 0.01));
    draw();
  });
  ["pointerup", "pointercancel"].forEach(function (name) { svg.addEventListener(name, function () { start = null; }); });
}
