// Draws the charts of the report in the colours of the page, light or dark, on screen or paper.
(() => {
  const { CONFIG, SCREEN_BUTTONS, SPACE_BUTTONS, GAP, palette, coloured, triples, put, arrows,
    hasDepth } = drawing;
  const root = document.documentElement;
  const paper = "paper" in root.dataset;
  const PAPER_WIDTH = 680; // pixels between the margins of A4
  const PAPER_HEIGHT = 0.8; // of the height on a screen
  const NARROW = window.matchMedia("(max-width: 40rem)"); // no room for buttons beside the legend
  const figures = [...document.querySelectorAll(".chart")].map((element) => ({
    element, ...JSON.parse(element.nextElementSibling.textContent),
  }));
  const state = { shown: 1, times: 0, pose: 0, printing: paper };

  const heightOf = (figure) => Math.round(figure.height * (state.printing ? PAPER_HEIGHT : 1));
  const sizeOf = (figure) => ({ height: heightOf(figure),
    ...(state.printing ? { width: PAPER_WIDTH, autosize: false } : { autosize: true }) });

  // ---- charts ----------------------------------------------------------------------------------

  function draw(figure) {
    const flat = !figure.arms;
    if (!flat && state.printing) return null; // a still picture stands in its place
    const colours = palette();
    const traces = flat ? figure.traces : inSpace(figure);
    const buttons = flat ? SCREEN_BUTTONS : SPACE_BUTTONS;
    figure.element.querySelector(".waiting")?.remove();
    figure.element.style.height = `${heightOf(figure)}px`;
    const layout = drawing.layoutOf(figure, colours, sizeOf(figure));
    return Plotly.react(figure.element, coloured(traces, colours), layout,
      { ...CONFIG, ...buttons, displayModeBar: NARROW.matches ? false : "hover" });
  }

  function drawAll() {
    return figures.map(draw);
  }

  // ---- the view in space -----------------------------------------------------------------------

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
