/* Talking to the server. The token is kept for this tab only, and sent in headers only. */
"use strict";
const api = (function () {
  const TOKEN = "dnrpipe.token";
  function headers(more) {
    const token = sessionStorage.getItem(TOKEN);
    return Object.assign(token ? { Authorization: "Bearer " + token } : {}, more);
  }
  async function ask(path, options) {
    let answer;
    try {
      answer = await fetch(path, Object.assign({}, options, { headers: headers(options && options.headers) }));
    } catch (error) {
      if (error.name === "AbortError") throw error;
      throw new Error("The server does not answer. Is it running, and is this machine connected?");
    }
    if (answer.headers.has("www-authenticate")) document.dispatchEvent(new CustomEvent("token-wanted"));
    if (!answer.ok) {
      const body = await answer.json().catch(function () { return {}; });
      const refused = new Error(body.detail || "The server answered " + answer.status + " to " + path + ".");
      refused.status = answer.status;  // it did answer: asking again will not help
      throw refused;
    }
    return answer;
  }
  return {
    setToken: function (token) { sessionStorage.setItem(TOKEN, token); },
    hasToken: function () { return Boolean(sessionStorage.getItem(TOKEN)); },
    ask: ask,
    get: async function (path) { return (await ask(path)).json(); },
    post: async function (path, value) {
      const body = value === undefined ? {} : { body: JSON.stringify(value), headers: { "Content-Type": "application/json" } };
      return (await ask(path, Object.assign({ method: "POST" }, body))).json();
    },
    remove: async function (path) { return (await ask(path, { method: "DELETE" })).json(); },
    /* PUT a file; `told` hears the share that is sent, 0 to 1. */
    upload: function (path, file, told) {
      return new Promise(function (done, failed) {
        const request = new XMLHttpRequest();
        request.open("PUT", path);
        Object.entries(headers({ "Content-Type": "application/octet-stream" })).forEach(function (entry) { request.setRequestHeader(entry[0], entry[1]); });
        request.upload.addEventListener("progress", function (event) { if (event.lengthComputable) told(event.loaded / event.total); });
        request.addEventListener("error", function () { failed(new Error("The server does not answer. Is it running, and is this machine connected?")); });
        request.addEventListener("load", function () {
          let body = {};
          try { body = JSON.parse(request.responseText); } catch (error) { /* said below */ }
          if (request.getResponseHeader("www-authenticate")) document.dispatchEvent(new CustomEvent("token-wanted"));
          if (request.status < 300) done(body);
          else failed(new Error(body.detail || "The server answered " + request.status + " to " + path + "."));
        });
        request.send(file);
      });
    },
    picture: async function (path) { return URL.createObjectURL(await (await ask(path)).blob()); },
    /* Events of a job, until it has ended or `signal` is aborted; takes a broken stream up. Throws what refuses it. */
    events: async function (job, signal, seen) {
      let last = 0, ended = false, pause = 1000;
      while (!ended && !signal.aborted) {
        try {
          const answer = await ask("/jobs/" + job + "/events", { signal: signal, headers: { "Last-Event-ID": String(last) } });
          const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
          let rest = "";
          for (;;) {
            const part = await reader.read();
            if (part.done) break;
            const blocks = (rest + part.value).split("\n\n");
            rest = blocks.pop();
            blocks.forEach(function (block) {
              const fields = {};
              block.split("\n").forEach(function (line) {
                const at = line.indexOf(":");
                if (at > 0) fields[line.slice(0, at)] = line.slice(at + 1).trim();
              });
              if (fields.id) last = Number(fields.id);
              if (fields.event === "end") ended = true;
              else if (fields.event) pause = 1000, seen(fields.event, JSON.parse(fields.data));
            });
          }
        } catch (error) {
          if (signal.aborted) return;
          if (error.status >= 400 && error.status < 500 && error.status !== 429) throw error;
          pause = Math.min(30000, 2 * pause);
        }
        if (!ended) await new Promise(function (done) { setTimeout(done, pause); });
      }
    },
    socket: function (path) {
      const token = sessionStorage.getItem(TOKEN);
      const protocols = ["dnrpipe.live"].concat(token ? ["dnrpipe.token." + token] : []);
      return new WebSocket(location.origin.replace(/^http/, "ws") + path, protocols);
    },
  };
})();
