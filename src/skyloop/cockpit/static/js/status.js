// Flight state, battery, authority, links, and the alert line. Text says everything that a colour says.

import { byId, setAttribute, setText, setTone, words } from "./dom.js";

const STATE_TONES = { hovering: "ok", flying: "ok", taking_off: "busy", landing: "busy", emergency: "bad", unknown: "warn" };
const LINK_TONES = { up: "ok", degraded: "warn", lost: "bad", connecting: "busy", closed: "bad" };
const LOW_BATTERY = 0.2;
const SILENT_S = 1.0;

export class Status {
  constructor() {
    this.connected = null; // whether this page reaches the cockpit
    this.state = null;
    this.flies = true; // whether the vehicle can
  }

  setConnected(connected) {
    if (this.connected !== null || connected) this.connected = connected;
    this.hop("hop-page", connected ? "up" : "lost");
    if (!connected) for (const id of ["hop-application", "hop-vehicle"]) this.hop(id, null);
    this.alert();
  }

  update(state) {
    this.state = state;
    const { feedback, link } = state;
    this.hop("hop-application", link.application);
    const heard = link.application !== "lost";
    this.hop("hop-vehicle", heard ? link.vehicle : null);
    setText(byId("link-reason"), link.reason);
    setTone(byId("flight-state"), this.flies && heard ? (STATE_TONES[feedback?.state] ?? "quiet") : "quiet");
    setText(byId("flight-state-text"), this.flightState(feedback, heard));
    this.battery(feedback?.battery ?? null);
    this.authority(feedback, heard);
    this.alert();
  }

  flightState(feedback, heard) {
    if (!this.flies) return "can't fly";
    if (!feedback) return "no feedback yet";
    return heard ? words(feedback.state) : `last known: ${words(feedback.state)}`;
  }

  hop(id, state) {
    setTone(byId(id), LINK_TONES[state] ?? "quiet");
    setText(byId(id).querySelector(".hop-state"), state ?? "not known");
  }

  battery(charge) {
    const meter = byId("battery");
    const percent = charge === null ? null : Math.round(charge * 100);
    setTone(meter, charge === null ? "quiet" : charge < LOW_BATTERY ? "bad" : charge < 2 * LOW_BATTERY ? "warn" : "ok");
    setText(byId("battery-text"), percent === null ? "–" : `${percent} %`);
    setAttribute(byId("battery-level"), "width", String(25 * Math.max(0, Math.min(1, charge ?? 0))));
    setAttribute(meter, "aria-valuenow", String(percent ?? 0));
    setAttribute(meter, "aria-valuetext", percent === null ? "unknown" : `${percent} percent`);
  }

  authority(feedback, heard) {
    const owner = feedback?.owner ?? null;
    setText(byId("pilot"), owner ?? "nobody");
    setTone(byId("pilot"), owner && heard ? "ok" : "quiet");
    const more = owner
      ? `Holds the authority with priority ${feedback.owner_priority ?? "–"}, lease ${feedback.lease}.`
      : "Nobody holds the authority.";
    setText(byId("pilot-more"), more);
    const step = feedback?.failsafe ?? "none";
    const failsafe = byId("failsafe");
    const text = step === "none" ? "No failsafe in force" : `Failsafe: the proxy makes it ${step}`;
    setTone(failsafe, !heard || feedback === null ? "quiet" : step === "none" ? "ok" : "warn");
    setText(failsafe, heard ? text : "Failsafe not known");
  }

  /** The one thing that matters most now; spoken at once by screen readers, as the line is an alert. */
  alert() {
    const [text, tone] = this.worst();
    setTone(byId("alert"), tone);
    setText(byId("alert"), text);
  }

  worst() {
    if (this.connected === false) return ["This page lost the cockpit: what it shows is old. Trying again…", "bad"];
    if (!this.state) return ["", "warn"];
    const { feedback, link } = this.state;
    if (link.application === "lost") return ["The proxy does not answer: what is shown is old. Trying again…", "bad"];
    if (feedback?.state === "emergency") return ["Emergency: the motors are off.", "bad"];
    if (link.vehicle === "lost") return ["The vehicle does not answer its proxy.", "bad"];
    if (feedback && feedback.failsafe !== "none") return [`Failsafe in force: ${feedback.failsafe}.`, "warn"];
    if (feedback?.battery != null && feedback.battery < LOW_BATTERY) return ["Battery low.", "bad"];
    if (feedback && feedback.age_s > SILENT_S) return ["Feedback is old: the vehicle's state is not known.", "warn"];
    return ["", "warn"];
  }
}
