(function () {
  "use strict";
  document.documentElement.classList.add("js");

  document.querySelectorAll(".compare").forEach(function (box) {
    var input = box.querySelector("input");
    input.addEventListener("input", function () { box.style.setProperty("--split", input.value + "%"); });
  });

  document.querySelectorAll("svg[data-turn]").forEach(turnSphere);

  addEventListener("beforeprint", function () {
    document.querySelectorAll("details[data-print]").forEach(function (d) { d.open = true; });
  });
})();
