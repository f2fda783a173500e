"use strict";
// Shows a session as the server tells it, and passes on every choice; all work is the server's.
(() => {
  const root = document.documentElement, body = document.body;
  const home = `/s/${encodeURIComponent(body.dataset.session)}`;
  const WORKING = 400, IDLE = 2000; // milliseconds between two questions
  const FOREVER = 12; // seconds that a message stays
  const CLOSER = 0.75; // than in the report, which has more room
  const BADGES = { waiting: "", ready: "", working: "at work", done: "done", failed: "failed",
    old: "of earlier choices: do it again" };
  const MADE_BY = { fit: "fit", accuracy: "fit", points: "fit", ladder: "diagnose", verdict: "judge",
    plan: "plan", told: "correct", understood: "read" }; // panel: its step
  const NARROW = 500; // pixels in which a chart has no room for buttons
  const { coloured, palette, put, triples, arrows, GAP } = drawing;
  const byId = (id) => document.getElementById(id);
  const all = (selector) => [...document.querySelectorAll(selector)];
  let now = { choices: {}, views: {}, steps: {}, panels: {} };
  let stamp = "", asking = null;

  // ---- talking to the server ---------------------------------------------------------------------

  function complain(words) {
    const place = byId("problem");
    place.textContent = words;
    place.hidden = !words;
    clearTimeout(complain.timer);
    complain.timer = setTimeout(() => { place.hidden = true; }, 1000 * FOREVER);
  }

  async function ask(method, path, content) {
    let answer;
    try {
      answer = await fetch(`${home}${path}`, { method, body: content });
    } catch {
      throw new Error("The server does not answer: is minimax-cal serve still running?");
    }
    const text = await answer.text();
    let told;
    try { told = JSON.parse(text); } catch { told = { error: text }; }
    if (!answer.ok) throw new Error(told.error || `The server refused (${answer.status}).`);
    return told;
  }

  async function tell(method, path, content) {
    try {
      await ask(method, path, content);
      return true;
    } catch (error) {
      complain(error.message);
      return false;
    } finally {
      await refresh();
    }
  }

  const choose = (changes) => tell("PATCH", "/choices", JSON.stringify(changes));
  const run = (step) => tell("POST", `/run/${step}`, "");

  async function refresh() {
    clearTimeout(asking);
    try {
      const told = await ask("GET", `/state?seen=${stamp}`);
      if (told.stamp !== stamp) show(told);
      stamp = told.stamp;
      working(told.job);
      asking = setTimeout(refresh, told.job ? WORKING : IDLE);
    } catch (error) {
      complain(error.message);
      asking = setTimeout(refresh, 2 * IDLE);
    }
    body.dataset.stamp = stamp;
  }

  // ---- what the session is -----------------------------------------------------------------------

  function show(told) {
    const before = now;
    now = told;
    for (const [name, html] of Object.entries(told.panels)) {
      if (before.panels[name] !== html) fill(document.querySelector(`[data-panel="${name}"]`), html);
    }
    robots(told.robots);
    for (const field of all("input[name], select[name]")) settle(field, told.choices);
    for (const [name, step] of Object.entries(told.steps)) told_of(name, step);
    for (const [panel, step] of Object.entries(MADE_BY)) {
      document.querySelector(`[data-panel="${panel}"]`).classList.toggle("old", told.steps[step].state === "old");
    }
    badge("robot", told.choices.robot ? "done" : "ready");
    byId("all-back").disabled = !told.choices.left_out.length;
    byId("targets-told").textContent = told.choices.targets ? `given/${told.choices.targets}` : "";
    for (const name of ["workspace", "ladder"]) chart(name, told.views[name] ?? "");
    if (before.choices.most !== told.choices.most) drawCell();
  }

  function fill(place, html) {
    const focused = place.contains(document.activeElement) ? document.activeElement.id : "";
    const open = [...place.querySelectorAll("details")].map((part) => part.open);
    const top = place.querySelector(".tall")?.scrollTop ?? 0;
    place.innerHTML = html; // written by the server, every text escaped
    place.querySelectorAll("details").forEach((part, i) => { part.open = open[i] ?? part.open; });
    if (place.querySelector(".tall")) place.querySelector(".tall").scrollTop = top;
    if (focused) byId(focused)?.focus({ preventScroll: true });
  }

  function robots(list) {
    const place = byId("robot-choice");
    const known = [["", "choose one"], ...list];
    const text = JSON.stringify(known);
    if (place.dataset.known === text) return;
    place.dataset.known = text;
    place.replaceChildren(...known.map(([value, label]) => new Option(label, value)));
  }

  function settle(field, choices) {
    if (!(field.name in choices) || field === document.activeElement && field.type === "number") return;
    if (field === document.activeElement && field.type === "text") return;
    if (field.type === "checkbox") field.checked = choices[field.name];
    else field.value = choices[field.name] ?? "";
  }

  function badge(name, state) {
    for (const place of all(`[data-dot="${name}"]`)) place.dataset.state = state;
    for (const place of all(`[data-badge="${name}"]`)) {
      place.dataset.state = state;
      place.textContent = BADGES[state];
    }
  }

  const made = (kind, words, name = "") =>
    Object.assign(document.createElement(kind), { textContent: words, className: name });

  function told_of(name, step) {
    badge(name, step.state);
    const place = document.querySelector(`[data-said="${name}"]`);
    place.dataset.state = step.state;
    if (name === "read" && step.error) byId("untold").open = true;
    if (name === "diagnose") byId("chart-ladder").classList.toggle("old", step.state !== "done");
    const parts = [];
    if (step.error) parts.push(made("p", step.error, "problem"));
    if (step.waits) parts.push(made("p", step.waits, "waits"));
    if (step.state === "old" && name !== "read") parts.push(made("p", BADGES.old, "waits"));
    if (step.lines.length) {
      const box = made("pre", step.lines.join("\n"));
      const copy = made("button", "copy");
      copy.type = "button";
      copy.addEventListener("click", async () => {
        await navigator.clipboard.writeText(step.lines.join("\n"));
        copy.textContent = "copied";
      });
      box.append(copy);
      parts.push(box);
    }
    if (step.notices.length) {
      const more = document.createElement("details");
      more.append(made("summary", `${step.notices.length} notice${step.notices.length > 1 ? "s" : ""}`),
        ...step.notices.map((words) => made("p", words, "notice")));
      parts.push(more);
    }
    place.replaceChildren(...parts);
    for (const button of all(`[data-run="${name}"]`)) button.dataset.waits = step.waits;
  }

  const clock = (seconds) => (seconds < 60 ? `${seconds} s`
    : `${Math.floor(seconds / 60)} min ${seconds % 60} s`);

  function working(job) {
    byId("bar").hidden = !job;
    for (const button of all("[data-run]")) button.disabled = Boolean(job) || Boolean(button.dataset.waits);
    if (!job) return;
    const left = job.left ? `, ${job.left}` : "";
    byId("bar-told").textContent = `${job.step}: ${job.stage} (${clock(job.seconds)}${left})`;
    const done = byId("bar-done");
    if (job.done === null) done.removeAttribute("value"); else done.value = job.done;
  }

  // ---- what people do ----------------------------------------------------------------------------

  async function upload(files, kind) {
    const most = Number(body.dataset.most);
    const names = [];
    for (const file of files) {
      if (file.size > most) {
        complain(`${file.name}: is larger than ${most / 2 ** 20} MiB; that is no file of measurements`);
        return;
      }
    }
    for (const file of files) {
      try {
        names.push((await ask("PUT", `/given?name=${encodeURIComponent(file.name)}`, file)).name);
      } catch (error) {
        complain(error.message);
        return;
      }
    }
    if (!names.length) return;
    const taken = await tell("POST", "/given", JSON.stringify({ kind, names }));
    if (taken && kind === "measured") await run("read");
    if (taken) return;
    const chosen = new Set([...now.choices.measured, now.choices.robot, now.choices.targets]);
    for (const name of names.filter((one) => !chosen.has(one))) { // it is of no use here
      await ask("DELETE", `/given?name=${encodeURIComponent(name)}`).catch(() => null);
    }
  }

  // ---- a DH table that is typed: a CSV of it goes the way of a dropped file ----------------------

  const DH = { a_mm: "0", alpha_deg: "0", d_mm: "0", theta_deg: "0", offset_deg: "0", sign: "1",
    lower_deg: "", upper_deg: "" };

  function dhRows() {
    const rows = document.querySelector("#dh-table tbody");
    const count = Math.min(Math.max(Number(byId("dh-joints").value) || 1, 1), 12);
    while (rows.children.length > count) rows.lastChild.remove();
    while (rows.children.length < count) {
      const number = rows.children.length + 1, row = made("tr", "");
      row.append(made("th", `${number}`));
      for (const [name, value] of Object.entries(DH)) {
        const cell = made("td", ""), field = made("input", "");
        Object.assign(field, { type: "text", inputMode: "decimal", value, size: 7 });
        field.setAttribute("aria-label", `joint ${number}, ${name}`);
        cell.append(field);
        row.append(cell);
      }
      rows.append(row);
    }
  }

  document.querySelector("#dh-table thead tr").append(...Object.keys(DH).map((name) => made("th", name)));
  byId("dh-joints").addEventListener("change", dhRows);
  dhRows();
  byId("dh-use").addEventListener("click", async () => {
    const rows = [...document.querySelectorAll("#dh-table tbody tr")].map((row) =>
      [...row.querySelectorAll("input")].map((field) => field.value.trim().replace(",", ".")));
    const wrong = rows.flat().find((text) => text && !Number.isFinite(Number(text)));
    if (wrong !== undefined) { complain(`${wrong}: is no number`); return; }
    const kept = Object.keys(DH).map((name, i) => [name, i]).filter(([, i]) => rows.some((row) => row[i]));
    const lines = [`# convention: ${byId("dh-convention").value}`, kept.map(([name]) => name).join(","),
      ...rows.map((row) => kept.map(([, i]) => row[i]).join(","))];
    const name = byId("dh-name").value.replace(/[^\w-]+/g, "_") || "arm";
    await upload([new File([`${lines.join("\n")}\n`], `${name}.csv`)], "robot");
  });

  for (const place of all("[data-drop]")) {
    const kind = place.dataset.drop, input = place.querySelector("input");
    input.addEventListener("change", async () => {
      await upload([...input.files], kind);
      input.value = "";
    });
    place.addEventListener("dragover", () => place.classList.add("over"));
    for (const end of ["dragleave", "drop"]) {
      place.addEventListener(end, () => place.classList.remove("over"));
    }
  }
  for (const kind of ["dragover", "drop"]) { // a file beside the areas does not open instead
    window.addEventListener(kind, (event) => { if (!event.target.closest?.("[data-drop]")) event.preventDefault(); });
  }

  document.addEventListener("change", (event) => {
    const field = event.target;
    if (field.dataset.point) {
      const left = now.choices.left_out.filter((key) => key !== field.dataset.point);
      const id = `why-${field.dataset.point.replace(":", "-")}`; // where the reason is asked for
      choose({ left_out: field.checked ? left : [...left, field.dataset.point] })
        .then(() => document.getElementById(id)?.focus());
    } else if (field.dataset.why) {
      choose({ reasons: { ...now.choices.reasons, [field.dataset.why]: field.value } });
    } else if (field.dataset.joints !== undefined) {
      choose({ joints: field.checked ? field.dataset.joints : "" });
    } else if (field.name in now.choices) {
      const value = field.type === "checkbox" ? field.checked
        : field.type === "number" ? (field.value === "" ? null : Number(field.value)) : field.value;
      choose({ [field.name]: value });
    }
  });

  document.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    if (button.dataset.run) run(button.dataset.run);
    else if (button.dataset.remove) {
      tell("DELETE", `/given?name=${encodeURIComponent(button.dataset.remove)}`);
    } else if (button.dataset.show) {
      const at = cell?.arms.poses.findIndex((pose) => pose.line === Number(button.dataset.show)) ?? -1;
      if (at >= 0) { byId("pose").value = at; drawCell(); byId("cell").scrollIntoView({ block: "center" }); }
    } else if (button.id === "cancel") tell("POST", "/cancel", "");
    else if (button.id === "all-back") choose({ left_out: [], reasons: {} });
  });

  // ---- charts ------------------------------------------------------------------------------------

  const drawn = {}; // what each chart shows
  let cell = null, ladder = null;

  async function chart(name, version) {
    if (drawn[name] === version) return;
    drawn[name] = version;
    const found = version ? await ask("GET", `/view/${name}?of=${version}`).catch(() => null) : null;
    if (drawn[name] !== version) return; // a later one is on its way
    if (name === "ladder") { ladder = found; drawLadder(); return; }
    const first = !cell;
    cell = found;
    if (cell) for (const axis of "xyz") cell.layout.scene.camera.eye[axis] *= CLOSER;
    byId("cell").hidden = !cell;
    if (!cell) return;
    const { arms } = cell;
    byId("times").max = arms.steps.length - 1;
    byId("pose").max = arms.poses.length - 1;
    if (first) byId("pose").value = arms.worst;
    byId("times").value = arms.steps.indexOf(arms.start[shown()]);
    drawCell();
  }

  const shown = () => Number(document.querySelector("input[name=shown]:checked").value);

  const called = (key) => { // a point, by the names that its file gives
    const [line, target] = key.split(":");
    return `${cell.arms.called[line]}, ${target}`;
  };

  // The errors in two colours where a limit is given: within it, and beyond.
  function errorTraces(arms) {
    const number = shown(), errors = number ? arms.after : arms.before;
    const size = number ? arms.size : arms.size_before, limit = now.choices.most;
    const points = triples(arms.points), vectors = triples(errors);
    const kinds = limit ? [["good", `within ${limit} mm`, "circle", (s) => s <= limit],
      ["bad", `beyond ${limit} mm`, "x", (s) => s > limit]]
      : [[number ? "after" : "before", "error", "circle", () => true]];
    return kinds.flatMap(([colour, name, symbol, holds]) => {
      const some = size.map((s, i) => i).filter((i) => holds(size[i]));
      const flat = (list) => some.flatMap((i) => list[i]);
      const trace = { type: "scatter3d", name: `${name} (${some.length})`, legendgroup: name };
      const at = triples(flat(points));
      return [
        { ...put({ ...trace, mode: "lines", hoverinfo: "skip", showlegend: false,
          line: { color: colour, width: 4 } },
        arrows(flat(points), flat(vectors), arms.steps[Number(byId("times").value)])) },
        { ...put({ ...trace, mode: "markers" }, at),
          customdata: some.map((i) => arms.keys[i]), hovertemplate: "%{text}<extra></extra>",
          text: some.map((i) => `${called(arms.keys[i])}: ${size[i].toFixed(3)} mm`),
          marker: { color: colour, symbol, size: symbol === "x" ? 4 : 3.5 } },
      ];
    });
  }

  function drawCell() {
    if (!cell) return;
    const { arms, traces } = cell, pose = arms.poses[Number(byId("pose").value)], arm = triples(pose.arm);
    if (!drawing.hasDepth()) {
      byId("chart-workspace").textContent = "This browser cannot draw in three dimensions; the table of points holds the errors.";
      return;
    }
    const colours = palette();
    const content = [
      ...errorTraces(arms),
      put(traces[2], arm),
      put(traces[3], arms.corners.map((i) => arm[i])),
      put(traces[4], triples(pose.spots).flatMap((spot) => [arm.at(-1), spot, GAP])),
      ...traces.slice(5),
    ];
    const place = byId("chart-workspace");
    const layout = drawing.layoutOf(cell, colours, { height: place.clientHeight, autosize: true });
    Plotly.react(place, coloured(content, colours), layout,
      { ...drawing.CONFIG, ...drawing.SPACE_BUTTONS, scrollZoom: true,
        displayModeBar: place.clientWidth > NARROW });
    if (!place.dataset.drawn) place.on("plotly_click", picked);
    place.dataset.drawn = "yes";
    byId("times-told").textContent = `× ${arms.steps[Number(byId("times").value)]}`;
    byId("pose-told").textContent = `${arms.called[pose.line]} (${pose.held ? "held out" : "training"}): `
      + pose.error.map((size, i) => `${arms.names[i]} ${size === null ? "–" : size.toPrecision(3)} mm`).join(", ");
    byId("cell-told").textContent = `Arrows go from where the model says to where the reflector was measured, `
      + `magnified. Click a reflector to bring the arm there and to find its row.`;
  }

  function picked(event) {
    const key = event.points.map((point) => point.customdata).find((data) => typeof data === "string");
    if (!key) return;
    const [line, target] = key.split(":");
    const at = cell.arms.poses.findIndex((pose) => pose.line === Number(line));
    if (at >= 0) byId("pose").value = at;
    drawCell();
    for (const row of all("tr.chosen")) row.classList.remove("chosen");
    const row = byId(`point-${line}-${target}`);
    if (!row) return;
    row.classList.add("chosen");
    const box = row.closest(".tall");
    box.scrollTop = row.offsetTop - box.clientHeight / 2;
  }

  function drawLadder() {
    const place = byId("chart-ladder");
    place.hidden = !ladder;
    if (!ladder) return;
    const colours = palette();
    place.style.height = `${ladder.height}px`;
    Plotly.react(place, coloured(ladder.traces, colours),
      drawing.layoutOf(ladder, colours, { height: ladder.height, autosize: true }),
      { ...drawing.CONFIG, ...drawing.SCREEN_BUTTONS });
    place.dataset.drawn = "yes";
  }

  for (const id of ["times", "pose"]) byId(id).addEventListener("input", drawCell);
  for (const choice of all("input[name=shown]")) {
    choice.addEventListener("change", () => {
      if (cell) byId("times").value = cell.arms.steps.indexOf(cell.arms.start[shown()]);
      drawCell();
    });
  }

  // ---- light and dark ----------------------------------------------------------------------------

  const dark = matchMedia("(prefers-color-scheme: dark)");
  const isDark = () => (root.dataset.theme ? root.dataset.theme === "dark" : dark.matches);
  const dress = () => {
    byId("theme").setAttribute("aria-pressed", String(isDark()));
    drawCell();
    drawLadder();
  };
  byId("theme").addEventListener("click", () => { root.dataset.theme = isDark() ? "light" : "dark"; dress(); });
  dark.addEventListener("change", dress);
  byId("theme").setAttribute("aria-pressed", String(isDark()));

  refresh();
})();
