/* The dashboard: jobs, one job as it runs, one workspace. */
"use strict";
(function () {
  const $ = function (id) { return document.getElementById(id); };
  const FINAL = ["done", "failed", "cancelled"];
  let job = null, watching = null, over = false, workspace = null, asked = null, sphere = null;
  document.documentElement.classList.add("js");

  function clock(seconds) {
    const s = Math.round(seconds);
    return (s >= 3600 ? Math.floor(s / 3600) + ":" + String(Math.floor(s / 60) % 60).padStart(2, "0") : Math.floor(s / 60)) + ":" + String(s % 60).padStart(2, "0");
  }
  /* What an action ran into stays until the next one succeeds, or until it is dismissed. */
  function problem(error) { $("problem-text").textContent = error.message; $("problem").hidden = false; }
  function settled() { $("problem").hidden = true; }
  $("dismiss").addEventListener("click", function () { settled(); $("file").focus(); });
  function say(node, text) { if (node.textContent !== text) node.textContent = text; }
  function cell(text, tag) { const node = document.createElement(tag || "td"); node.textContent = text; return node; }
  function button(text, act) {
    const node = document.createElement("button");
    node.type = "button"; node.textContent = text;
    node.addEventListener("click", function () { Promise.resolve(act()).then(settled).then(refresh).catch(problem); });
    return node;
  }
  /* Children of `parent`, one for each entry, in order: those that are there stay, so that focus does. */
  function update(parent, entries, key, make, change) {
    const known = new Map(Array.from(parent.children, function (node) { return [node.dataset.key, node]; }));
    const names = new Set(entries.map(function (entry) { return String(key(entry)); }));
    known.forEach(function (node, name) { if (!names.has(name)) node.remove(); });
    entries.forEach(function (entry, index) {
      const name = String(key(entry)), node = known.get(name) || make(entry);
      node.dataset.key = name;
      change(node, entry);
      if (parent.children[index] !== node) parent.insertBefore(node, parent.children[index] || null);
    });
  }

  let locked = false;  // without the token nothing is asked again and again
  document.addEventListener("token-wanted", function () { locked = true; $("token-form").hidden = false; });
  $("token-form").addEventListener("submit", function (event) {
    event.preventDefault();
    api.setToken($("token").value.trim());
    $("token").value = ""; $("token-form").hidden = true; locked = false;
    refresh();
  });

  let pages = [], older = null;  // `before` of each page that was turned to
  $("older").addEventListener("click", function () { if (older !== null) pages.push(older); refresh(); });
  $("newer").addEventListener("click", function () { pages.pop(); refresh(); });
  $("search").addEventListener("input", function () { pages = []; refresh(); });

  /* Jobs that were submitted here and have not ended; told of by the browser once they have. */
  const mine = new Set();
  $("notify").addEventListener("change", async function () {
    if (!$("notify").checked) return;
    const allowed = "Notification" in window ? await Notification.requestPermission() : "denied";
    if (allowed !== "granted") { $("notify").checked = false; problem(new Error("This browser allows no notifications from here.")); }
  });
  async function tellOfEnded() {
    for (const id of Array.from(mine)) {
      const entry = await api.get("/jobs/" + id);
      if (!FINAL.includes(entry.state)) continue;
      mine.delete(id);
      if ($("notify").checked) new Notification("dnrpipe: job " + id + " " + entry.state, { body: entry.error || entry.request.command + " " + entry.request.workspace });
    }
  }

  async function refresh() {
    try {
      const health = await api.get("/healthz");
      $("health").textContent = health.status + " · " + health.running + " running, " + health.queued + " queued · workers: " +
        (Object.keys(health.workers).map(function (d) { return d + (health.workers[d] ? "" : " (down)"); }).join(", ") || "none here");
      const query = new URLSearchParams({ limit: "30", search: $("search").value });
      if (pages.length) query.set("before", pages[pages.length - 1]);
      const page = await api.get("/jobs?" + query);
      older = page.next;
      $("pages").hidden = !pages.length && older === null;
      $("newer").disabled = !pages.length; $("older").disabled = older === null;
      showJobs(page.jobs);
      showWorkspaces(await api.get("/workspaces"));
      showDeleted(await api.get("/deleted"));
      await tellOfEnded();
    } catch (error) { $("health").textContent = error.message; }
  }
  function showJobs(jobs) {
    $("no-jobs").hidden = jobs.length > 0;
    $("jobs").hidden = !jobs.length;
    update($("jobs").tBodies[0], jobs, function (entry) { return entry.id; }, function (entry) {
      const row = document.createElement("tr"), name = document.createElement("td");
      row.dataset.job = entry.id;
      name.append(button("", function () { select(row.entry); }));
      name.firstChild.className = "link";
      row.append(cell(entry.id), name, cell(""), cell(entry.owner || ""), document.createElement("td"));
      row.addEventListener("click", function (event) { if (!event.target.closest("button")) select(row.entry); });
      return row;
    }, function (row, entry) {
      const final = FINAL.includes(entry.state), act = final ? (entry.state === "done" ? "" : "retry") : "cancel";
      const state = row.children[2], acts = row.children[4];
      row.entry = entry;
      row.classList.toggle("selected", entry.id === job);
      say(row.children[1].firstChild, entry.request.command + " " + entry.request.workspace);
      row.children[1].firstChild.setAttribute("aria-current", entry.id === job ? "true" : "false");
      say(state, entry.state);
      state.className = "state-" + entry.state;
      if (acts.dataset.act !== act) {
        const focused = acts.contains(document.activeElement);
        acts.dataset.act = act;
        acts.replaceChildren();
        if (act) {
          acts.append(button(act, function () { return api.post("/jobs/" + entry.id + "/" + act); }));
          acts.firstChild.setAttribute("aria-label", act + " job " + entry.id);
        }
        if (focused) (acts.firstChild || row.children[1].firstChild).focus();
      }
      if (entry.id === job && over && !final) select(entry);  // tried again: watched again
    });
    const chosen = jobs.find(function (entry) { return entry.id === job; });
    if (chosen) {
      $("job-error").hidden = !chosen.error;
      say($("job-error"), chosen.error || "");
    }
  }
  function showWorkspaces(found) {
    $("no-workspaces").hidden = found.length > 0;
    update($("workspaces"), found, function (entry) { return entry.name; }, function (entry) {
      const item = document.createElement("li");
      item.append(button(entry.name, function () { return open(entry.name); }), document.createElement("span"));
      return item;
    }, function (item, entry) { 
      say(item.children[1], " " + (entry.problem || size(entry.mb) + (entry.owner ? ", " + entry.owner : "")));
    });
    const names = found.map(function (entry) { return entry.name; }), list = $("workspace"), before = list.value;
    if (Array.from(list.options, function (o) { return o.value; }).slice(1).join() !== names.join()) {
      list.replaceChildren.apply(list, [""].concat(names).map(function (name) { return new Option(name || "(the scene's)", name); }));
      list.value = before;
    }
  }

  function showDeleted(found) {
    $("deleted-card").hidden = !found.length;
    update($("deleted"), found, function (entry) { return entry.id; }, function (entry) {
      const item = document.createElement("li"), back = button("Restore", function () { return api.post("/deleted/" + entry.id + "/restore"); });
      back.setAttribute("aria-label", "Restore " + entry.name);
      item.append(entry.name + ", gone for good " + new Date(1000 * entry.until).toLocaleString() + " ", back);
      return item;
    }, function () {});
  }
  function size(mb) { return mb >= 1024 ? (mb / 1024).toFixed(1) + " GiB" : mb >= 10 ? Math.round(mb) + " MiB" : mb >= 1 ? mb.toFixed(1) + " MiB" : Math.ceil(1024 * mb) + " KiB"; }

  async function showResults(name) {
    const found = await api.get("/workspaces/" + name + "/results");
    if (name !== workspace) return;
    $("results-card").hidden = !found.length;
    update($("results"), found, function (entry) { return name + " " + entry.file; }, function (entry) {
      const item = document.createElement("li");
      item.append(button(entry.file, function () { return save("/workspaces/" + name + "/results/" + entry.file, name + "-" + entry.file.split("/").pop()); }), document.createElement("span"));
      return item;
    }, function (item, entry) { say(item.children[1], " " + entry.kind + ", " + size(entry.mb)); });
  }
  /* A link carries no token: fetched, and saved as a file. */
  async function save(path, name) {
    const link = document.createElement("a");
    link.href = await api.picture(path);
    link.download = name;
    link.click();
    setTimeout(function () { URL.revokeObjectURL(link.href); }, 60000);
  }
  $("delete").addEventListener("click", function () {
    $("sure-text").textContent = "Delete " + workspace + " with all that is in it? It can be restored for some days.";
    $("sure").hidden = false; $("sure-no").focus();
  });
  $("sure-no").addEventListener("click", function () { $("sure").hidden = true; $("delete").focus(); });
  $("sure-yes").addEventListener("click", function () {
    $("sure").hidden = true;
    api.remove("/workspaces/" + workspace).then(function () { workspace = asked = null; $("detail").hidden = true; $("file").focus(); }).then(settled).then(refresh).catch(problem);
  });

  function select(entry) {
    if (watching) watching.abort();
    watching = new AbortController();
    job = entry.id; over = false;
    const losses = {}, quality = [];
    $("job").hidden = false;
    $("job-title").textContent = "Job " + entry.id + ": " + entry.request.command + " " + entry.request.workspace;
    $("bar").value = 0; $("note").textContent = entry.state; $("log").textContent = ""; $("curves").replaceChildren();
    $("live").hidden = true;
    const mine = watching;
    let drawn = 0, due = false, looked = Date.now(), shown = null;
    function draw() {
      due = false; drawn = Date.now();
      const series = Object.keys(losses).map(function (name) { return { name: name, points: losses[name] }; });
      $("curves").replaceChildren(plot("losses", series, true));
      if (quality.length) $("curves").append(plot("validation, dB", [{ name: "PSNR", points: quality }], false));
    }
    api.events(entry.id, watching.signal, function (kind, data) {
      if (asked === entry.request.workspace && kind !== "state" && Date.now() - looked > 5000) {
        looked = Date.now();  // stages and costs go on meanwhile
        open(asked).catch(problem);
      }
      if (kind === "progress") {
        $("bar").max = data.total; $("bar").value = data.done;
        $("note").textContent = data.label + ": " + data.done + " of " + data.total +
          (data.seconds_left === null ? "" : ", " + clock(data.seconds_left) + " left") + (data.note ? " · " + data.note : "");
      } else if (kind === "message") {
        $("log").textContent += data.text + "\n";
      } else if (kind === "epoch") {
        Object.keys(data.losses).forEach(function (name) { (losses[name] = losses[name] || []).push([data.epoch, data.losses[name]]); });
        if (data.val && data.val.psnr) quality.push([data.epoch, data.val.psnr]);
        if (!due) { due = true; setTimeout(draw, Math.max(0, 300 - (Date.now() - drawn))); }
      } else if (kind === "preview") {
        if (shown === null) setTimeout(function () {  // of many from the past, the last one
          const last = shown;
          shown = null;
          live(entry.request.workspace, last, mine).catch(problem);
        }, 200);
        shown = data;
      } else if (kind === "picture" && asked === entry.request.workspace) {
        open(asked, data.view).catch(problem);
      } else if (kind === "state") {
        $("note").textContent = data.state + (data.why ? ": " + data.why : "");
        if (FINAL.includes(data.state)) {
          refresh();
          if (asked === entry.request.workspace) open(asked).catch(problem);
        }
      }
    }).then(function () { over = mine === watching || over; }).catch(problem);
    open(entry.request.workspace).catch(function () { if (asked === entry.request.workspace) $("detail").hidden = true; });
    refresh();
  }

  /* The picture that the event `told` tells of, unless another training has replaced it. */
  async function live(name, told, mine) {
    const base = "/workspaces/" + name + "/preview", found = await api.get(base);
    if (Math.abs(found.time - told.time) > 5) return;
    const pictures = { prediction: await api.picture(base + "/prediction") };
    if (found.truth) pictures.truth = await api.picture(base + "/truth");
    const wanted = mine === watching;  // else another job was chosen meanwhile
    Object.keys(pictures).forEach(function (kind) {
      URL.revokeObjectURL(wanted ? $("live-" + kind).src : pictures[kind]);
      if (wanted) $("live-" + kind).src = pictures[kind];
    });
    if (!wanted) return;
    $("live-beside").hidden = !found.truth;
    $("live-caption").textContent = (found.split === "test" ? "Test view " + found.view + ", which training never sees" : "Training view " + found.view + "; none is held out") +
      ": epoch " + found.epoch + " of " + found.epochs +
      (found.psnr === null ? ". evaluate will ray-trace its reference." : ", " + found.psnr.toFixed(2) + " dB");
    $("live").dataset.epoch = found.epoch;
    $("live").hidden = false;
  }

  function showPlan(plan) {
    $("plan").hidden = !plan;
    if (!plan) return;
    $("plan").caption.textContent = "Plan: " + plan.views + " views, " + plan.spp + " spp, " + plan.epochs + " epochs" + (plan.fits ? "" : "; the settings are others now");
    const rows = plan.stages.map(function (s) {
      return [s.stage, clock(s.predicted), s.spent === null ? "done before" : clock(s.spent) + (s.done || !s.spent ? "" : " so far"), s.spent > s.predicted * plan.high / plan.total];
    });
    rows.splice(3, 0, ["until the renderer is there", clock(plan.total) + " (" + clock(plan.low) + " to " + clock(plan.high) + ")", clock(plan.spent), plan.spent > plan.high]);
    $("plan").tBodies[0].replaceChildren.apply($("plan").tBodies[0], rows.map(function (row, i) {
      const line = document.createElement("tr"), spent = cell(row[2]);
      spent.classList.toggle("over", row[3]);
      line.classList.toggle("sum", i === 3);
      line.append(cell(row[0], "th"), cell(row[1]), spent);
      return line;
    }));
  }

  /* Shows the workspace, unless another one is asked for before the server has answered. */
  async function open(name, view) {
    asked = name;
    const found = await api.get("/workspaces/" + name);
    if (name !== asked) return;
    workspace = name;
    $("detail").hidden = false;
    $("detail-title").textContent = name;
    $("open-viewer").hidden = !found.viewable;
    $("open-viewer").href = "/static/viewer.html?w=" + name;
    $("open-report").hidden = !found.report;
    $("open-report").href = "/workspaces/" + name + "/report";
    const body = $("stages").tBodies[0];
    const named = found.stages.map(function (stage) { return stage.stage; });
    const rows = found.stages.concat(Object.keys(found.costs.spent).filter(function (stage) { return !named.includes(stage); }).map(function (stage) {
      return { stage: stage, command: stage, state: "", present: null };  // plan, render: no stages, but paid for
    }));
    body.replaceChildren.apply(body, rows.map(function (stage) {
      const row = document.createElement("tr");
      const spent = found.costs.spent[stage.stage];
      row.append(cell(stage.command, "th"), cell(stage.state), cell(stage.present === null ? "" : stage.present + " of " + stage.wanted), cell(spent ? clock(spent) : ""));
      return row;
    }));
    const costs = found.costs;
    $("cost").textContent = "Cost so far " + clock(costs.total) + "." + (costs.traced_views === null ? "" :
      " Ray-traced " + costs.traced_views + " of " + costs.candidates + " candidates in " + clock(costs.tracing_seconds) + "; all would have cost " + clock(costs.tracing_all_seconds) + ".");
    $("sure").hidden = true;
    showPlan(found.plan);
    await showResults(name);
    if (name !== asked) return;
    $("sphere-card").hidden = !found.sphere;
    if (found.sphere && found.sphere !== sphere) {  // else it stays as it was turned
      sphere = found.sphere;
      $("sphere").dataset.eye = found.eye.join(" ");
      $("sphere").innerHTML = found.sphere;  // made by the server from numbers and escaped names
      turnSphere($("sphere").querySelector("svg"));
    }
    $("history").replaceChildren.apply($("history"), found.training.map(function (step) {
      return plot(step.title, Object.keys(step.losses).map(function (name) { return { name: name, points: step.losses[name] }; }), true);
    }));
    $("pictures").hidden = !found.tests.length;
    if (found.tests.length) {
      view = view || $("view").value;
      $("view").replaceChildren.apply($("view"), found.tests.map(function (t) {
        return new Option(t.view + (t.psnr === null ? "" : ", " + t.psnr.toFixed(2) + " dB"), t.view);
      }));
      if (found.tests.some(function (t) { return t.view === view; })) $("view").value = view;
      await pictures();
    }
  }
  async function pictures() {
    const name = workspace, path = "/workspaces/" + name + "/pictures/" + $("view").value + "/";
    for (const kind of ["truth", "prediction"]) {
      const picture = await api.picture(path + kind);
      const wanted = name === asked;
      URL.revokeObjectURL(wanted ? $(kind).src : picture);
      if (!wanted) return;
      $(kind).src = picture;
    }
    $("psnr").textContent = "Held-out view " + $("view").selectedOptions[0].text;
  }
  $("view").addEventListener("change", function () { pictures().catch(problem); });
  $("split").addEventListener("input", function () { $("split").parentElement.style.setProperty("--split", $("split").value + "%"); });
  $("open-report").addEventListener("click", function (event) {
    if (!api.hasToken()) return;
    event.preventDefault();
    save("/workspaces/" + workspace + "/report", workspace + ".html").catch(problem);
  });

  $("submit").addEventListener("submit", async function (event) {
    event.preventDefault();
    settled();
    try {
      const file = $("file").files[0], budget = $("budget").value, request = { command: $("command").value, workspace: $("workspace").value, settings: {} };
      if (file) {
        const dot = file.name.lastIndexOf("."), stem = file.name.slice(0, dot).replace(/[^A-Za-z0-9_-]/g, "-").replace(/^[-_]+/, "").slice(0, 64);
        request.scene = stem + file.name.slice(dot).toLowerCase();
        request.workspace = request.workspace || stem;
        $("upload").textContent = "uploading " + file.name;
        const stored = await api.upload("/scenes/" + request.scene, file, function (share) { say($("upload"), "uploading " + file.name + ", " + Math.round(100 * share) + " %"); });
        request.scene_sha256 = stored.sha256;
        if (stored.replaced) problem(new Error("Another file named " + request.scene + " was there. Jobs that were submitted with it keep it."));
      }
      if (budget) request.settings["select.budget"] = Number(budget);
      if ($("preset").value) request.preset = $("preset").value;
      if (Number($("priority").value)) request.priority = Number($("priority").value);
      if ($("orbit").value && request.command === "render") request.orbit = Number($("orbit").value);
      ["frames", "size"].forEach(function (name) { if ($(name).value && request.command === "shot") request[name] = $(name).value.trim(); });
      $("settings").value.split("\n").forEach(function (line) {
        const at = line.indexOf("=");
        if (at > 0) request.settings[line.slice(0, at).trim()] = line.slice(at + 1).trim();
        else if (line.trim()) throw new Error("Settings: " + line.trim() + " is not KEY=VALUE.");
      });
      const made = await api.post("/jobs", request);
      mine.add(made.id);
      $("upload").textContent = "job " + made.id;
      select(made);
    } catch (error) { $("upload").textContent = ""; problem(error); }
  });

  refresh();
  setInterval(function () { if (!document.hidden && !locked) refresh(); }, 3000);
})();
