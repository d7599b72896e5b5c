"use strict";
// The live view: shows what the program sends over a websocket, and sends what the controls ask for.
(function () {
  var SEARCH = ["horizon", "num_samples", "num_iterations", "warm_start_iterations", "deadline_ms"];
  var HISTORY = 300;  // decisions in a chart
  var REDRAW_MS = 250;
  var history = { number: [], surprise: [], decision_ms: [], busy_ms: [] };
  var settings = null, fan = null, periodMs = 0, isDirty = false, socket = null;

  function find(id) { return document.getElementById(id); }
  function write(id, text) { find(id).textContent = text; }
  function digits(value, count) { return value === null || value === undefined ? "-" : value.toFixed(count); }
  function refuse(reason) { write("refusal", reason); find("refusal").hidden = false; }
  function send(request) {
    find("refusal").hidden = true;
    if (socket.readyState === WebSocket.OPEN) { socket.send(JSON.stringify(request)); }
  }

  // What arrives.

  var handlers = {
    moment: showMoment,
    future: showFuture,
    settings: showSettings,
    picture: addPicture,
    refused: function (reason) {
      refuse(reason);
      if (settings) { showChoices(settings); }  // instead of what was refused
    }
  };

  function connect() {
    socket = new WebSocket(location.origin.replace(/^http/, "ws") + "/live");
    socket.onmessage = function (event) {
      var message = JSON.parse(event.data), kind = Object.keys(message)[0];
      handlers[kind](message[kind]);
    };
    socket.onopen = function () { find("state").classList.remove("lost"); find("gallery").textContent = ""; };
    socket.onclose = function () {
      write("state", "The program has ended or cannot be reached. Trying again ...");
      find("state").classList.add("lost");
      setTimeout(connect, 2000);
    };
  }

  function showMoment(moment) {
    find("camera").src = moment.frame;
    periodMs = moment.period_ms;
    write("state", "episode " + moment.episode + ", decision " + moment.decision + " | return " +
      digits(moment.total, 1) + " | " + digits(moment.rate, 1) + " decisions/s, " + moment.late + " late | decided in " +
      digits(moment.decision_ms, 1) + " ms by the " + moment.source + (moment.pushed ? " | pushed" : ""));
    for (var name in history) {
      history[name].push(moment[name]);
      if (history[name].length > HISTORY) { history[name].shift(); }
    }
    fillTable("quantities", Object.keys(moment.quantities).map(function (name) {
      return [name, digits(moment.quantities[name], 2), (settings && settings.units[name]) || ""];
    }));
    var rows = moment.clauses.map(function (clause) { return [clause[0], clause[1] ? "yes" : "no"]; });
    if (moment.score !== null) { rows.push(["score of the objective", digits(moment.score, 2)]); }
    find("clauses").hidden = rows.length === 0;
    fillTable("clauses", rows);
    isDirty = true;
  }

  function showFuture(future) {
    var steps = future.steps.join(", "), names = Object.keys(future.rewards);
    var rows = names.map(function (name, index) {
      return (names.length === 1 ? "" : index === 0 ? "upper row " : "lower row ") + "along the " + name +
        " (predicted reward " + digits(future.rewards[name], 2) + ")";
    });
    find("imagined").src = future.picture;
    var ahead = settings ? " of " + digits(settings.period_ms, 0) + " ms" : "";
    write("imagined-text", "Imagined at decision " + future.number + ": " + steps + " steps" + ahead + " ahead, " +
      rows.join(", ") + ".");
    if (future.fan) {
      fan = future.fan;
      write("fan-text", "The last iteration of the search at decision " + future.number +
        ". A line is the first number of the action over the steps of a sequence.");
    } else if (settings && !settings.searches_here) {
      fan = null;
      write("fan-text", "In mode " + settings.mode + " no search is made that could be shown here.");
    }
    isDirty = true;
  }

  function fillTable(id, rows) {
    var body = find(id).tBodies[0];
    while (body.rows.length > rows.length) { body.deleteRow(-1); }
    rows.forEach(function (row, index) {
      var line = body.rows[index] || body.insertRow();
      row.forEach(function (text, column) {
        var cell = line.cells[column] || line.insertCell();
        if (cell.textContent !== text) { cell.textContent = text; }
        if (id === "quantities" && column === 1) { cell.className = "number"; }
        if (id === "clauses" && column === 1) { cell.className = text === "yes" ? "met" : text === "no" ? "unmet" : ""; }
      });
    });
  }

  function showSettings(given) {
    settings = given;
    var mode = find("mode");
    if (mode.options.length === 0) {
      given.modes.forEach(function (name) { mode.add(new Option(name)); });
    }
    find("plans").hidden = given.plans;
    fill("objective", given.objective);
    fill("constraint", given.constraint);
    showChoices(given);
    SEARCH.forEach(function (name) {
      var own = given.own[name];
      find(name).placeholder = own === null ? (name === "deadline_ms" ? "none" : "half of the first") : own;
    });
    if (given.goal_horizon && given.search.horizon === null) {
      find("horizon").placeholder = given.own.horizon + ", with a goal " + given.goal_horizon;
    }
    find("body").disabled = false;
    ["force", "push-left", "push-right"].forEach(function (name) { find(name).disabled = given.weight === null; });
    if (given.weight === null) {
      write("push-text", "This environment has no push.");
    } else {
      if (!find("force").value) { find("force").value = Math.round(given.weight); }
      find("force").max = Math.round(given.most_push);
      write("push-text", "A push is a force on the body's part \"" + given.pushed_body + "\" for " + given.push_s +
        " s of simulated time. The body weighs " + digits(given.weight, 0) + " N.");
    }
  }

  function fill(name, value) {  // but not where someone types
    if (document.activeElement !== find(name)) { find(name).value = value; }
  }

  function showChoices(given) {
    find("mode").value = given.mode;
    SEARCH.forEach(function (name) { fill(name, given.search[name] === null ? "" : given.search[name]); });
  }

  function addPicture(given) {
    var known = Array.from(find("gallery").children).some(function (each) { return each.dataset.name === given.name; });
    if (known) { return; } // a page that opens may be sent a picture twice
    var button = document.createElement("button"), picture = document.createElement("img");
    button.type = "button";
    button.dataset.name = given.name;
    button.title = "Pursue " + given.name;
    picture.src = given.address;
    picture.alt = "Goal picture " + given.name;
    button.append(picture);
    button.addEventListener("click", function () {
      find("objective").value = "goal:" + given.name;
      pursue();
    });
    find("gallery").append(button);
  }

  // What the controls ask for.

  function pursue() { send({ objective: find("objective").value, constraint: find("constraint").value }); }
  function push(sign) {
    var force = Number(find("force").value);
    send({ push: sign * (Number.isFinite(force) ? force : 0) });
  }

  find("controls").addEventListener("submit", function (event) { event.preventDefault(); pursue(); });
  find("task").addEventListener("click", function () {
    find("objective").value = find("constraint").value = "";
    pursue();
  });
  ["mode"].concat(SEARCH).forEach(function (name) {
    find(name).addEventListener("change", function () {
      var request = {};
      request[name] = find(name).value;
      send(request);
    });
  });
  find("push-left").addEventListener("click", function () { push(-1); });
  find("push-right").addEventListener("click", function () { push(1); });
  find("reset").addEventListener("click", function () { send({ reset: true }); });
  find("snapshot").addEventListener("click", function () { send({ picture: "camera" }); });
  find("file").addEventListener("change", function () {
    var reader = new FileReader(), file = this.files[0];
    reader.onload = function () { send({ picture: reader.result.split(",")[1] || "" }); };
    if (file && settings && file.size > settings.largest_picture) {  // a message that is too large would end the connection
      refuse(settings.picture_rule);
    } else if (file) {
      reader.readAsDataURL(file);
    }
    this.value = "";
  });

  // Charts.

  function color(name) { return getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim(); }

  function draw(id, traces, xTitle, yTitle, more) {
    var axis = { gridcolor: color("line"), linecolor: color("faint"), zeroline: false, automargin: true };
    var layout = {
      margin: { l: 46, r: 8, t: 8, b: 36 },
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: color("ink"), size: 12, family: "system-ui, DejaVu Sans, sans-serif" },
      showlegend: true,
      legend: { orientation: "h", x: 0, y: 1, yanchor: "bottom" },
      xaxis: Object.assign({ title: { text: xTitle, standoff: 6 } }, axis, more && more.xaxis),
      yaxis: Object.assign({ title: { text: yTitle, standoff: 6 } }, axis, more && more.yaxis)
    };
    Plotly.react(id, traces, layout, { staticPlot: true, responsive: true });
  }

  // Many sequences as one line with gaps.
  function joined(rows) {
    var x = [], y = [];
    rows.forEach(function (row) {
      row.forEach(function (value, step) { x.push(step + 1); y.push(value); });
      x.push(null);
      y.push(null);
    });
    return { x: x, y: y };
  }

  function drawFan(index) {
    var own = fan ? fan[index] : null;
    if (fan) { find("fan-1-card").hidden = fan.length < 2; }
    if (index === 1 && find("fan-1-card").hidden) { return; }
    var parts = own || { candidates: [], elites: [], mean: [] };
    var lines = [
      ["candidates", parts.candidates, color("faint"), 1, 0.55],
      ["elites", parts.elites, color("series-1"), 1, 0.8],
      ["mean", [parts.mean], color("series-2"), 2.5, 1]
    ].map(function (part) {
      return Object.assign(joined(part[1]), {
        name: part[0], mode: "lines", opacity: part[4], line: { color: part[2], width: part[3] }
      });
    });
    draw("fan-" + index, lines, "step of the plan", "action " + (index + 1) + " (-1 to 1)", {
      xaxis: { dtick: parts.mean.length > 12 ? 5 : 1 },
      yaxis: { range: [-1.08, 1.08] }
    });
  }

  // The highest value that a chart shows: rare outliers would press everything else flat.
  function highest(values, least) {
    var sorted = values.filter(Number.isFinite).sort(function (a, b) { return a - b; });
    return 1.15 * Math.max(least, sorted.length ? sorted[Math.floor(0.98 * (sorted.length - 1))] : 0);
  }

  function drawHistory(id, names, yTitle, level) {
    var numbers = history.number, traces = names.map(function (each, index) {
      return {
        x: numbers.slice(), y: history[each[0]].slice(), name: each[1], mode: "lines",
        line: { color: color("series-" + (index + 1)), width: 1.4, dash: index ? "dash" : "solid" }
      };
    });
    if (level && numbers.length) {
      traces.push({
        x: [numbers[0], numbers[numbers.length - 1]], y: [level[1], level[1]], name: level[0], mode: "lines",
        line: { color: color("faint"), width: 1.2, dash: "dot" }
      });
    }
    var values = names.reduce(function (all, each) { return all.concat(history[each[0]]); }, []);
    draw(id, traces, "decision", yTitle, { yaxis: { range: [0, highest(values, level ? level[1] : 1)] } });
  }

  function redraw() {
    if (!isDirty || document.hidden) { return; }
    isDirty = false;
    drawFan(0);
    drawFan(1);
    var limit = settings && settings.surprise_limit;
    drawHistory("surprise", [["surprise", "surprise"]], "surprise (nats)", limit ? ["limit", limit] : null);
    drawHistory("latency", [["decision_ms", "decision"], ["busy_ms", "all work"]], "time (ms)", ["period", periodMs]);
  }

  document.addEventListener("themechange", function () { isDirty = true; });
  setInterval(redraw, REDRAW_MS);
  connect();
})();
