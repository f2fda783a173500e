"use strict";
// What the report and the page to work in draw with: colours of the page, layouts, arrows in space.
const drawing = (() => {
  const root = document.documentElement;
  const SCREEN_BUTTONS = { modeBarButtons: [["toImage", "zoom2d", "pan2d", "resetScale2d"]] };
  const SPACE_BUTTONS = { modeBarButtons: [["toImage", "resetCameraDefault3d"]] };
  const CONFIG = { responsive: true, displaylogo: false, showLink: false, showSendToCloud: false,
    showEditInChartStudio: false, plotlyServerURL: "", scrollZoom: false };

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

  // size: of the chart, its height among it.
  function layoutOf(figure, colours, size) {
    const axis = { gridcolor: colours.line, linecolor: colours.soft, zerolinecolor: colours.line,
      tickcolor: colours.soft, automargin: true, showline: true, ticks: "outside", ticklen: 4 };
    const font = { color: colours.ink, size: 12, family: getComputedStyle(document.body).fontFamily };
    return {
      ...coloured(figure.layout, colours),
      ...size, font,
      modebar: { bgcolor: "rgba(0,0,0,0)", color: colours.soft, activecolor: colours.ink }, uirevision: "kept",
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      hoverlabel: { bgcolor: colours.back, bordercolor: colours.soft, font },
      template: { layout: { xaxis: axis, yaxis: axis } },
    };
  }

  // ---- in space --------------------------------------------------------------------------------

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

  function hasDepth() {
    const canvas = document.createElement("canvas");
    return Boolean(canvas.getContext("webgl2") || canvas.getContext("webgl"));
  }

  return { CONFIG, SCREEN_BUTTONS, SPACE_BUTTONS, GAP, palette, coloured, layoutOf, triples, put,
    arrows, hasDepth };
})();
