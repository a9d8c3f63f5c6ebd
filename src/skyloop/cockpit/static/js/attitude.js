// Artificial horizon, heading tape and the figures below them. Angles arrive in radians, REP 103 signs:
// roll positive right side down, pitch positive nose down, yaw counter-clockwise from east.

import { byId, figure, setAttribute, setText, svg } from "./dom.js";

const PITCH_SCALE = 2.1; // units of the drawing per degree
const TAPE_SCALE = 1.7;
const POINTS = { 0: "N", 90: "E", 180: "S", 270: "W" };
const degrees = (radians) => (radians * 180) / Math.PI;

export class Attitude {
  constructor() {
    const ladder = byId("ladder");
    for (const angle of [-30, -20, -10, 10, 20, 30]) {
      const y = -angle * PITCH_SCALE;
      ladder.append(svg("line", { x1: -22, x2: 22, y1: y, y2: y }));
      ladder.append(svg("text", { x: 27, y }, String(Math.abs(angle))));
    }
    for (const angle of [-15, -5, 5, 15]) {
      const y = -angle * PITCH_SCALE;
      ladder.append(svg("line", { x1: -11, x2: 11, y1: y, y2: y }));
    }
    const scale = byId("roll-scale");
    for (const angle of [-60, -45, -30, -20, -10, 0, 10, 20, 30, 45, 60]) {
      const long = angle % 30 === 0;
      scale.append(svg("line", { y1: -93, y2: long ? -100 : -97, transform: `rotate(${angle})` }));
    }
    const tape = byId("compass-tape");
    for (let heading = -360; heading <= 720; heading += 10) {
      const x = heading * TAPE_SCALE;
      const name = ((heading % 360) + 360) % 360;
      if (heading % 30 === 0) {
        tape.append(svg("text", { x, y: 21, class: POINTS[name] ? "" : "minor" }, POINTS[name] ?? String(name)));
      } else tape.append(svg("line", { x1: x, x2: x, y1: 12, y2: 18 }));
    }
    this.announced = 0;
  }

  update(feedback) {
    const known = feedback !== null && feedback.roll !== null && feedback.pitch !== null;
    const roll = known ? degrees(feedback.roll) : null;
    const noseUp = known ? -degrees(feedback.pitch) : null;
    const yaw = feedback?.yaw ?? null;
    const heading = yaw === null ? null : (((90 - degrees(yaw)) % 360) + 360) % 360;
    byId("horizon").classList.toggle("unknown", !known);
    byId("compass").classList.toggle("unknown", heading === null);
    if (known) {
      byId("horizon-roll").setAttribute("transform", `rotate(${-roll})`);
      byId("horizon-pitch").setAttribute("transform", `translate(0 ${noseUp * PITCH_SCALE})`);
    }
    if (heading !== null) byId("compass-tape").setAttribute("transform", `translate(${-heading * TAPE_SCALE} 0)`);
    const velocity = feedback?.velocity ?? null;
    setText(byId("altitude"), figure(feedback?.altitude, 2));
    setText(byId("climb"), figure(velocity?.[2], 2));
    setText(byId("speed"), figure(velocity && Math.hypot(velocity[0], velocity[1]), 2));
    setText(byId("roll"), figure(roll, 0));
    setText(byId("pitch"), figure(noseUp, 0));
    setText(byId("heading"), heading === null ? "–" : String(Math.round(heading) % 360).padStart(3, "0"));
    this.describe(roll, noseUp, heading);
  }

  /** For screen readers, as often as somebody may ask: once in two seconds. */
  describe(roll, noseUp, heading) {
    const now = performance.now();
    if (now - this.announced < 2000) return;
    this.announced = now;
    const side = roll >= 0 ? "right" : "left";
    const nose = noseUp >= 0 ? "up" : "down";
    const attitude =
      roll === null
        ? "attitude not known"
        : `${side} side down ${Math.abs(roll).toFixed(0)} degrees, nose ${nose} ${Math.abs(noseUp).toFixed(0)} degrees`;
    setAttribute(byId("horizon"), "aria-label", `Artificial horizon: ${attitude}`);
    setAttribute(byId("compass"), "aria-label", heading === null ? "Heading not known" : `Heading ${heading.toFixed(0)} degrees`);
  }
}
