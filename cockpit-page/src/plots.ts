// Rolling plots of any number in the feedback or the logs.

import uPlot from "uplot";
import { colour, h, memory, setText } from "./dom.js";
import { figure, plain, short } from "./format.js";
import type { History } from "./history.js";
import { t } from "./language/index.js";

const COLOURS = 8; // in the style sheet, and therefore the maximum number of plots
const FIRST = ["altitude", "velocity.forward", "velocity.left"]; // plotted until the person chooses
const SPANS_S = [10, 30, 60, 120];
const PERIOD_MS = 120; // interval between drawings
/** Numbers of programs and drivers, which may be small and still significant. */
const OF_ANY_SIZE = /^(log|native)\./;

/** Names by the part before their first dot, in the order of a picker. */
export function grouped(names: Iterable<string>): Map<string, string[]> {
  const groups = new Map<string, string[]>();
  for (const name of [...names].sort()) {
    const dot = name.indexOf(".");
    const group = dot < 0 ? "vehicle" : name.slice(0, dot);
    groups.set(group, [...(groups.get(group) ?? []), name]);
  }
  return groups;
}

export class Plots {
  readonly element: HTMLElement;
  private chosen: string[];
  private span_s = 30;
  private paused = false;
  private readonly picker = h("select", { "aria-label": t.plots.add, onchange: () => this.pick() });
  private readonly spans = h("select", { "aria-label": t.plots.span, onchange: () => this.resize() });
  private readonly pause = h("button", { type: "button", class: "small", "aria-pressed": "false", onclick: () => this.hold() }, t.plots.pause);
  private readonly legend = h("div", { class: "legend" });
  private readonly box = h("div", { class: "plot", role: "img", "aria-label": t.plots.label });
  private plot: uPlot | null = null;
  private drawn_ms = 0;
  private offered = 0;

  constructor(
    private readonly history: History,
    private readonly now_s: () => number,
  ) {
    const stored = memory.get("plots")?.split(" ").filter(Boolean);
    this.chosen = stored?.length ? stored : [...FIRST];
    this.spans.append(...SPANS_S.map((span) => h("option", { value: span, selected: span === this.span_s }, `${span} s`)));
    this.element = h("div", { class: "filling plots" }, h("div", { class: "filters" }, this.picker, this.spans, this.pause), this.legend, this.box);
    this.offer();
    this.relegend();
    new ResizeObserver(() => this.rebuild()).observe(this.box);
  }

  draw(now_ms: number): void {
    if (this.paused || now_ms - this.drawn_ms < PERIOD_MS || !this.box.clientWidth) return;
    this.drawn_ms = now_ms;
    if (document.activeElement !== this.picker) this.offer(); // not while a person uses it
    const now_s = this.now_s();
    this.plot?.batch((plot: uPlot) => {
      const [times, ...series] = this.history.since(now_s - this.span_s - 1, this.chosen);
      plot.setData([times?.map((at_s) => (at_s ?? 0) - now_s), ...series] as uPlot.AlignedData, false);
      plot.setScale("x", { min: -this.span_s, max: 0 });
    });
    this.chosen.forEach((name, place) => {
      const value = this.legend.children[place]?.querySelector("output");
      if (value) setText(value, short(this.history.newest(name), !OF_ANY_SIZE.test(name)));
    });
  }

  /** The colours have changed. */
  repaint(): void {
    this.rebuild();
  }

  private offer(): void {
    if (this.history.names.size === this.offered && this.picker.options.length) return;
    this.offered = this.history.names.size;
    const groups = [...grouped(this.history.names)].map(([group, names]) => {
      const options = h("optgroup", { label: group });
      options.append(...names.map((name) => h("option", { value: name }, name)));
      return options;
    });
    this.picker.replaceChildren(h("option", { value: "" }, t.plots.addShort), ...groups);
  }

  private pick(): void {
    const name = this.picker.value;
    this.picker.value = "";
    this.picker.blur(); // so that letters fly again
    if (name && !this.chosen.includes(name)) this.choose([...this.chosen.slice(-(COLOURS - 1)), name]);
  }

  private choose(names: string[]): void {
    this.chosen = names;
    memory.set("plots", names.join(" "));
    this.relegend();
    this.rebuild();
  }

  private relegend(): void {
    this.legend.replaceChildren(
      ...this.chosen.map((name, place) =>
        h(
          "span",
          { class: "series", "data-series": place % COLOURS },
          h("i", { class: "swatch" }),
          h("span", { class: "series-name" }, name),
          h("output", {}, "–"),
          h("button", { type: "button", class: "bare", "aria-label": t.plots.remove(name), onclick: () => this.choose(this.chosen.filter((one) => one !== name)) }, "×"),
        ),
      ),
    );
  }

  private resize(): void {
    this.span_s = Number(this.spans.value);
    this.spans.blur();
  }

  private hold(): void {
    this.paused = !this.paused;
    this.pause.setAttribute("aria-pressed", String(this.paused));
  }

  private rebuild(): void {
    const [width, height] = [this.box.clientWidth, this.box.clientHeight];
    this.plot?.destroy();
    this.plot = null;
    if (width < 50 || height < 50) return;
    const axis = { stroke: colour("muted"), grid: { stroke: colour("line"), width: 1 }, ticks: { show: false }, font: "11px system-ui, sans-serif" };
    const ago = (_: uPlot, marks: number[]): string[] => marks.map((mark) => (mark === 0 ? "now" : `${figure(mark, 0)} s`));
    this.plot = new uPlot(
      {
        width,
        height,
        legend: { show: false },
        cursor: { show: false },
        padding: [8, 16, 0, 0],
        scales: { x: { time: false, auto: false }, y: { auto: true, range: (_, least, most) => padded(least, most) } },
        axes: [
          { ...axis, size: 24, values: ago, space: 60 },
          { ...axis, size: 46, values: (_, marks) => marks.map(plain) },
        ],
        series: [{}, ...this.chosen.map((name, place) => ({ label: name, stroke: colour(`series-${place % COLOURS}`), width: 1.5, points: { show: false } }))],
      },
      this.history.since(Number.POSITIVE_INFINITY, this.chosen) as uPlot.AlignedData,
      this.box,
    );
    this.drawn_ms = 0;
    if (this.paused) {
      this.paused = false;
      this.draw(performance.now());
      this.paused = true;
    }
  }
}

/** Some room above and below; a range for constant values. */
function padded(least: number | null, most: number | null): [number, number] {
  if (least === null || most === null) return [-1, 1];
  const room = Math.max((most - least) * 0.1, Math.abs(most) * 0.02, 0.05);
  return [least - room, most + room];
}
