"use strict";
// Draws the charts of the report in the colours of the page, light or dark, on screen or paper.
(() => {
  const root = document.documentElement;
  const paper = "paper" in root.dataset;
  const PAPER_WIDTH = 680; // pixels between the margins of A4
  const PAPER_HEIGHT = 0.8; // of the height on a screen
  const NARROW = window.matchMedia("(max-width: 40rem)"); // no room for buttons beside the legend
  const SCREEN_BUTTONS = { modeBarButtons: [["toImage", "zoom2d", "pan2d", "resetScale2d"]] };
  const SPACE_BUTTONS = { modeBarButtons: [["toImage", "resetCameraDefault3d"]] };
  const CONFIG = { responsive: true, displaylogo: false, showLink: false, showSendToCloud: false,
    showEditInChartStudio: false, plotlyServerURL: "", scrollZoom: false };
  const figures = [...document.querySelectorAll(".chart")].map((element) => ({
    element, ...JSON.parse(element.nextElementSibling.textContent),
  }));
  const state = { shown: 1, times: 0, pose: 0, printing: paper };

  // ---- colours ---------------------------------------------------------------------------------

  function palette() {
    const probe = document.createElement("span");
    document.body.append(probe);
    const found = {};
    for (const name of root.dataset.palette.split(" ")) {
      probe.style.color = `var(--${name})`;
      found[name] = getComputedStyle(probe).color;
    }
    probe.remove();
    return found;
  }

  // Colours stand under keys that end in "color" or "colorscale": no other text is touched.
  function coloured(value, colours, key = "") {
    if (Array.isArray(value)) return value.map((part) => coloured(part, colours, key));
    if (value !== null && typeof value === "object") {
      return Object.fromEntries(Object.entries(value).map(
        ([name, part]) => [name, coloured(part, colours, name)]));
    }
    const isColour = typeof value === "string" && /color(scale)?$/.test(key);
    return isColour && Object.hasOwn(colours, value) ? colours[value] : value;
  }

  const heightOf = (figure) => Math.round(figure.height * (state.printing ? PAPER_HEIGHT : 1));

  function layoutOf(figure, colours) {
    const axis = { gridcolor: colours.line, linecolor: colours.soft, zerolinecolor: colours.line,
      tickcolor: colours.soft, automargin: true, showline: true, ticks: "outside", ticklen: 4 };
    const font = { color: colours.ink, size: 12, family: getComputedStyle(document.body).fontFamily };
    const size = state.printing ? { width: PAPER_WIDTH, autosize: false } : { autosize: true };
    return {
      ...coloured(figure.layout, colours),
      ...size, height: heightOf(figure), font,
      modebar: { bgcolor: "rgba(0,0,0,0)", color: colours.soft, activecolor: colours.ink }, uirevision: "kept",
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      hoverlabel: { bgcolor: colours.back, bordercolor: colours.soft, font },
      template: { layout: { xaxis: axis, yaxis: axis } },
    };
  }

  // ---- charts ----------------------------------------------------------------------------------

  function draw(figure) {
    const flat = !figure.arms;
    if (!flat && state.printing) return null; // a still picture stands in its place
    const colours = palette();
    const traces = flat ? figure.traces : inSpace(figure);
    const buttons = flat ? SCREEN_BUTTONS : SPACE_BUTTONS;
    figure.element.querySelector(".waiting")?.remove();
    figure.element.style.height = `${heightOf(figure)}px`;
    return Plotly.react(figure.element, coloured(traces, colours), layoutOf(figure, colours),
      { ...CONFIG, ...buttons, displayModeBar: NARROW.matches ? false : "hover" });
  }

  function drawAll() {
    return figures.map(draw);
  }

  // ---- the view in space -----------------------------------------------------------------------

  const triples = (flat) => Array.from({ length: flat.length / 3 },
    (_, i) => flat.slice(3 * i, 3 * i + 3));
  const put = (trace, points) => ({ ...trace,
    x: points.map((p) => p[0]), y: points.map((p) => p[1]), z: points.map((p) => p[2]) });
  const GAP = [NaN, NaN, NaN];

  // Lines with heads; a head lies in the plane of its arrow and the vertical.
  function arrows(points, errors, times) {
    const starts = triples(points), out = [];
    triples(errors).forEach((error, i) => {
      const from = starts[i], along = error.map((e) => e * times);
      const flat = Math.hypot(along[0], along[1]), long = Math.hypot(...along);
      const side = flat > 1e-9 * long
        ? [-along[0] * along[2] / flat, -along[1] * along[2] / flat, flat] : [long, 0, 0];
      const tip = from.map((f, j) => f + along[j]);
      const wing = (sign) => tip.map((t, j) => t - 0.25 * along[j] + sign * 0.1 * side[j]);
      out.push(from, tip, wing(1), GAP, tip, wing(-1), GAP);
    });
    return out;
  }

  function inSpace(figure) {
    const { arms, traces } = figure, times = arms.steps[state.times], pose = arms.poses[state.pose];
    const arm = triples(pose.arm);
    const shows = (number) => state.shown === number || state.shown === 2;
    const lines = (key, number) => (shows(number) ? arrows(arms.points, arms[key], times) : []);
    return [
      { ...put(traces[0], lines("before", 0)), showlegend: shows(0) },
      { ...put(traces[1], lines("after", 1)), showlegend: shows(1) },
      put(traces[2], arm),
      put(traces[3], arms.corners.map((i) => arm[i])),
      put(traces[4], triples(pose.spots).flatMap((spot) => [arm.at(-1), spot, GAP])),
      ...traces.slice(5),
    ];
  }

  function told(arms) {
    const pose = arms.poses[state.pose], [one, other] = pose.error;
    const number = (value) => (value === null ? "-" : `${value.toPrecision(3)} mm`);
    document.getElementById("times-told").textContent = `× ${arms.steps[state.times]}`;
    document.getElementById("pose-told").textContent =
      `line ${pose.line} (${pose.held ? "held out" : "training"}): ` +
      `${arms.names[0]} ${number(one)}, ${arms.names[1]} ${number(other)}`;
  }

  function control(figure) {
    const { arms } = figure;
    const times = document.getElementById("times"), pose = document.getElementById("pose");
    const start = (shown) => arms.steps.indexOf(
      shown === 2 ? Math.min(...arms.start) : arms.start[shown]);
    const again = () => { told(arms); draw(figure); };
    state.pose = arms.worst;
    state.times = start(state.shown);
    times.value = state.times;
    told(arms);
    times.addEventListener("input", () => { state.times = Number(times.value); again(); });
    pose.addEventListener("input", () => { state.pose = Number(pose.value); again(); });
    for (const choice of document.querySelectorAll("input[name=shown]")) {
      choice.addEventListener("change", () => {
        state.shown = Number(choice.value);
        state.times = start(state.shown);
        times.value = state.times;
        again();
      });
    }
  }

  function hasDepth() {
    const canvas = document.createElement("canvas");
    return Boolean(canvas.getContext("webgl2") || canvas.getContext("webgl"));
  }

  // ---- the page --------------------------------------------------------------------------------

  const dark = matchMedia("(prefers-color-scheme: dark)");
  const button = document.getElementById("theme");
  const isDark = () => (root.dataset.theme ? root.dataset.theme === "dark" : dark.matches);

  function dress() {
    button.setAttribute("aria-pressed", String(isDark()));
    if (window.Plotly) drawAll();
  }

  button.addEventListener("click", () => {
    root.dataset.theme = isDark() ? "light" : "dark";
    dress();
  });
  dark.addEventListener("change", dress);

  let before = "";
  window.addEventListener("beforeprint", () => {
    before = root.dataset.theme ?? "";
    root.dataset.theme = "light";
    state.printing = true;
    dress();
  });
  window.addEventListener("afterprint", () => {
    if (before) root.dataset.theme = before; else delete root.dataset.theme;
    state.printing = paper;
    dress();
  });

  async function unpacked() {
    const letters = atob(document.getElementById("plotly").textContent);
    const bytes = Uint8Array.from(letters, (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = document.createElement("script");
    script.textContent = await new Response(stream).text();
    document.head.append(script);
  }

  function failed(error) {
    for (const waiting of document.querySelectorAll(".waiting")) {
      waiting.textContent = "This browser cannot draw the chart; the tables hold its numbers.";
    }
    document.querySelector(".view")?.classList.add("still-only");
    console.error(String(error));
    document.body.dataset.drawn = "failed";
  }

  async function start() {
    await unpacked();
    for (const figure of figures) {
      if (figure.arms && !hasDepth()) {
        figure.element.closest(".view").classList.add("still-only");
        continue;
      }
      if (figure.arms) control(figure);
      await draw(figure);
      await new Promise((next) => setTimeout(next)); // the page stays alive meanwhile
    }
    document.body.dataset.drawn = "yes";
  }

  button.setAttribute("aria-pressed", String(isDark()));
  if (paper) drawAll(); else start().catch(failed);
})();
