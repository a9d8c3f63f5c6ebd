// One open drone: everything shown and done about it.

import { AlarmBanner, AlarmBook } from "./alarms.js";
import type { AlarmSource } from "./alarmsound.js";
import { errorText, post } from "./api.js";
import { Battery } from "./battery.js";
import { CameraControls } from "./cameracontrols.js";
import { Channels } from "./channels.js";
import { ServerClock } from "./clock.js";
import { Deck } from "./deck.js";
import { h, memory, setAttribute, setDisabled, setHidden, setText, setTone, type Tone } from "./dom.js";
import { Events } from "./events.js";
import { corners, FlightHud } from "./flightmode.js";
import type { FollowHost } from "./followtool.js";
import { clock } from "./format.js";
import { Freshness } from "./freshness.js";
import { History, KEPT_S, Trail } from "./history.js";
import type { Countdown } from "./hold.js";
import { Instruments } from "./instruments.js";
import { named, t } from "./language/index.js";
import type { Deed } from "./keys.js";
import { MapPanel } from "./mappanel.js";
import type { Alarm, DroneRow, RunningRecording, State, Vehicle } from "./model.js";
import { Parameters, Writes } from "./parameters.js";
import { Pilot } from "./pilot.js";
import { Plots } from "./plots.js";
import { Preflight } from "./preflight.js";
import { ReplayBar } from "./replaybar.js";
import { before, momentOf, type Playback, playbackOf, type Timeline } from "./replaytime.js";
import { titleOf } from "./row.js";
import { isRecording, type Target } from "./safety.js";
import type { SceneView } from "./scene.js";
import { LastingSocket } from "./socket.js";
import { Hands } from "./sticks.js";
import { Strip } from "./strip.js";
import { Thumbs } from "./thumbs.js";
import { Stage } from "./video.js";
import { type Body, othersOf, type Scene } from "./world.js";

export interface PaneHost {
  /** Of the last overview. */
  rows(): readonly DroneRow[];
  select(name: string): void;
  close(name: string): void;
  help(): void;
  /** Into its flight mode, or out of it. */
  fly(pane: Pane): void;
  /** Its kind has become known: it could be flown. */
  known(pane: Pane): void;
  fillScreen(): void;
  /** Start or stop recording its flight. */
  record(pane: Pane): Promise<void>;
  /** With or without the panels beside the picture: remembered. */
  panels(shown: boolean): void;
  /** Its emergency stop, or the outcome of one, may have changed. */
  aimed(name: string): void;
  readonly countdown: Countdown;
}

const NOTICE_MS = 9000; // how long a message is shown
/** A first connection that takes longer raises an alarm. */
const CONNECT_MS = 1500;
const FLIGHT_TONES: Readonly<Record<string, Tone>> = { landed: "quiet", unknown: "quiet", emergency: "bad", landing: "busy", taking_off: "busy", hovering: "ok", flying: "ok" };
const now_s = (): number => performance.now() / 1000;

export class Pane {
  readonly element: HTMLElement;
  readonly pilot: Pilot | null;
  /** Its line of alarms and messages, in which the page also shows messages about all drones. */
  readonly said = h("div", { class: "said" });
  private vehicle: Vehicle | null = null;
  private state: State | null = null;
  private connected = false;
  private absent = "";
  private dirty = false;
  private readonly clock = new ServerClock();
  private readonly socket: LastingSocket;
  private control: LastingSocket | null = null;
  private renamed = false;
  private readonly history = new History();
  private readonly trail = new Trail();
  private readonly battery = new Battery();
  private readonly kind = h("span", { class: "kind" });
  private readonly endReplay = h("button", { type: "button", class: "small", hidden: true, onclick: () => void this.stopReplay() }, t.pane.endReplay);
  private readonly flight = h("span", {}, t.pane.noFeedback);
  private readonly pill = h("p", { class: "pill", role: "status", "aria-label": t.pane.flightState, "data-tone": "quiet" }, h("i", { class: "dot" }), this.flight);
  private readonly alarmBook = new AlarmBook();
  private readonly alarms = new AlarmBanner(this.alarmBook);
  private readonly opened_ms = performance.now();
  private wasConnected = false;
  private readonly fresh: Freshness;
  /** The replay has ended: the view shows its last state. */
  private readonly ended = h("p", { class: "banner ended-replay", role: "status", "data-tone": "quiet", hidden: true }, h("span", {}, t.pane.replayEnded), h("button", { type: "button", class: "small", onclick: () => this.host.close(this.name) }, t.modal.close));
  private readonly notice = h("p", { class: "banner notice", role: "alert", "data-tone": "warn" });
  private readonly hud = new FlightHud();
  private readonly title = h("h2");
  private readonly fly = h("button", { type: "button", class: "small fly", "aria-pressed": "false", onclick: () => this.host.fly(this) }, t.pane.flightMode);
  private readonly full = h("button", { type: "button", class: "full", "aria-label": t.pane.fullScreen, onclick: () => this.host.fillScreen() }, corners());
  private readonly panels = h("button", { type: "button", class: "small panels", "aria-pressed": "false", onclick: () => this.host.panels(this.panels.getAttribute("aria-pressed") !== "true") }, t.pane.panels);
  private readonly recordDot = h("i", { class: "record-dot" });
  private readonly recordText = h("span", {}, t.recordings.record);
  private readonly record = h("button", { type: "button", class: "small record-flight", hidden: true, onclick: () => void this.toggleRecord() }, this.recordDot, this.recordText);
  /** On the smaller one of picture and map, when the other fills nearly the whole pane: swaps them. */
  private readonly swap = h("button", { type: "button", class: "swap", onclick: () => this.enlarge(this.element.dataset["large"] === "map" ? "picture" : "map") }, h("span", { "aria-hidden": "true" }, "⤢"));
  private readonly stage: Stage;
  private readonly instruments = new Instruments();
  private readonly strip: Strip;
  readonly thumbs = new Thumbs();
  readonly hands = new Hands();
  private readonly map: MapPanel;
  private readonly writes: Writes;
  private readonly space = h("div", { class: "filling" });
  private readonly plots: Plots;
  private readonly events = new Events();
  private readonly channels = new Channels();
  private readonly parameters: Parameters;
  private readonly preflight: Preflight;
  private readonly controls: CameraControls;
  /** Of a replay: its bar, its position, and the flight as far as the cockpit knows it. */
  private bar: ReplayBar | null = null;
  private playback: Playback | null = null;
  private timeline: Timeline | null = null;
  private scene: SceneView | null = null;
  private readonly decks: Record<"space" | "plots" | "lists", Deck>;
  private noticed_ms = Number.NEGATIVE_INFINITY;

  constructor(
    readonly name: string,
    pilots: boolean,
    private readonly host: PaneHost,
  ) {
    this.fresh = new Freshness(name, this.clock, () => this.alarmBook.acknowledge("old", performance.now()) && this.update());
    const base = `/ws/drones/${encodeURIComponent(name)}`;
    this.controls = new CameraControls(name, (parameter, value) => this.pilot?.write(parameter, value));
    this.stage = new Stage(name, this.controls, pilots ? this.marking() : null);
    this.strip = new Strip(name, (deed) => this.act(deed), (id, grant, reason) => this.pilot?.answer(id, grant, reason), {
      countdown: host.countdown,
      deadly: () => (this.target === null ? null : { what: t.safety.motorsOff(name), act: () => this.target?.stop() }),
      understood: () => this.pilot?.understood(),
    });
    this.writes = new Writes((parameter, value) => this.pilot?.write(parameter, value));
    this.map = new MapPanel(name, {
      scene: () => this.world(),
      own: () => this.state?.position ?? null,
      stands: () => this.state?.flight === "landed",
      goTo: (x, y, z) => this.pilot?.goTo(x, y, z),
      flyRoute: (id) => this.pilot?.flyRoute(id),
      steerRoute: (deed) => this.pilot?.steerRoute(deed),
      write: (parameter, value) => this.writes.write(parameter, value),
    }, pilots);
    this.plots = new Plots(this.history, () => this.moment_s);
    this.parameters = new Parameters(name, (parameter, value) => this.pilot?.write(parameter, value));
    this.preflight = new Preflight(name);
    this.decks = {
      space: new Deck("space", [{ name: t.pane.map, element: this.map.element }, { name: "3-D", element: this.space, opened: () => void this.openSpace() }], t.pane.mapAndSpace),
      plots: new Deck("plots", [{ name: t.pane.plots, element: this.plots.element }], t.pane.plots),
      lists: new Deck("lists", [{ name: t.pane.events, element: this.events.element }, { name: t.pane.parameters, element: this.parameters.element, opened: () => void this.parameters.load() }, { name: t.pane.preflight, element: this.preflight.element, opened: () => void this.preflight.load() }], t.pane.lists),
    };
    this.element = this.build();
    this.enlarge(memory.get("large") ?? "picture");
    this.socket = new LastingSocket(`${base}/telemetry`, {
      message: (data) => this.onMessage(JSON.parse(data as string) as Vehicle | State),
      state: (open, code) => this.linked(open, code),
    });
    const control = (): string => `${base}/control?name=${encodeURIComponent(memory.get("name") ?? "")}`;
    this.pilot = pilots ? new Pilot((handlers) => (this.control = new LastingSocket(control, handlers)), this.clock, this.listener()) : null;
    this.update();
  }

  close(): void {
    this.pilot?.close();
    this.socket.close();
    this.stage.close();
    this.thumbs.forget();
    this.scene?.close();
    this.map.close();
    this.element.remove();
  }

  /** Another application asks for the control that this page has. */
  get isAsked(): boolean {
    return this.strip.question.isOpen;
  }

  /** It is a recording: nothing flies. */
  get isRecording(): boolean {
    return this.vehicle !== null && isRecording(this.vehicle);
  }

  /** What an emergency stop here stops; null if nothing flies, or for an observer. */
  get target(): Target | null {
    const { pilot } = this;
    if (pilot === null || this.isRecording || this.vehicle?.can_fly === false) return null;
    return { name: this.name, result: pilot.result("stop"), stop: () => pilot.act("stop") };
  }

  /** Its audible alarms. A recording has no present alarms. */
  get alarmSource(): AlarmSource {
    const { raised, loudest } = this.alarmBook;
    return { name: this.name, raised, loudest: this.isRecording ? null : loudest, repeats: true };
  }

  get isStopped(): boolean {
    return this.state?.flight === "emergency";
  }

  selected(selected: boolean): void {
    if (!selected) this.thumbs.release();
    setAttribute(this.element, "data-selected", String(selected));
  }

  /** Its layout in the window: alone with its picture first, or with its panels. */
  frame(alone: boolean, panels: boolean): void {
    setHidden(this.panels, !alone);
    setAttribute(this.panels, "aria-pressed", String(panels));
    setAttribute(this.element, "data-picture", String(alone && !panels));
  }

  /** Make the picture or the map the large one. */
  private enlarge(what: string): void {
    memory.set("large", what);
    setAttribute(this.element, "data-large", what);
    const [large, small] = what === "map" ? [this.decks.space.element, this.stage.element] : [this.stage.element, this.decks.space.element];
    small.append(this.swap);
    large.removeAttribute("data-small");
    setAttribute(small, "data-small", "true");
    setAttribute(this.swap, "aria-label", what === "map" ? t.pane.pictureLarge : t.pane.mapLarge);
  }

  /** Lay it out for flight mode, or as usual. */
  arrange(flight: boolean): void {
    setAttribute(this.element, "data-flight", String(flight));
    setAttribute(this.fly, "aria-pressed", String(flight));
    setAttribute(this.fly, "aria-label", flight ? t.pane.leaveFlightMode : t.pane.flightMode);
    setText(this.fly, flight ? "✕" : t.pane.flightMode);
    this.host.select(this.name);
  }

  act(deed: Deed | "reset"): void {
    this.host.select(this.name);
    setText(this.notice, ""); // of what was pressed before
    if (deed === "help") this.host.help();
    else if (this.isRecording) this.notify(t.pane.recording, "quiet");
    else if (this.pilot === null) this.notify(t.pane.watch, "warn");
    else if (deed === "follow") this.stage.toggleFollow() || this.notify(t.video.nothing, "warn");
    else if (deed === "question") this.strip.question.focus();
    else if (deed === "take") this.pilot.take(this.strip.wanted, this.strip.asks);
    else if (deed === "release") this.pilot.release();
    else if (deed !== "takeoff" || this.mayTakeOff()) this.pilot.act(deed);
  }

  /** False if the pilot must confirm first, because of a finding. */
  private mayTakeOff(): boolean {
    const question = this.state?.flight === "landed" ? this.preflight.ask(performance.now()) : "";
    if (question) this.notify(question, "bad");
    return question === "";
  }

  tick(now_ms: number): void {
    // Nothing new can arrive from a replay that has ended: its own banner says so.
    if (this.ended.hidden && this.fresh.update(now_ms, this.pilot?.age_ms(now_ms))) this.dirty = true;
    if (this.dirty) this.update();
    this.strip.count(this.pilot);
    this.stage.update(now_ms);
    this.bar?.update(this.playback, this.state?.links.vehicle === "closed", now_ms);
    this.preflight.watch((this.pilot?.mine ?? false) && this.state?.flight === "landed" && !this.fresh.isOld, now_ms);
    if (this.decks.space.shown === "Map") this.map.draw(now_ms);
    else this.scene?.draw(now_ms);
    this.plots.draw(now_ms);
    if (now_ms - this.noticed_ms > NOTICE_MS) setText(this.notice, "");
  }

  /** The person changed their name: it counts once this page neither has control nor waits for it. */
  rename(): void {
    this.renamed = true;
    this.update();
  }

  /** Show whether the drone is being recorded. */
  recorded(one: RunningRecording | null): void {
    setHidden(this.record, this.pilot === null || this.target === null);
    setText(this.recordText, one === null ? t.recordings.record : clock(one.seconds));
    setAttribute(this.recordDot, "class", one === null ? "record-dot" : "record-dot live");
    setAttribute(this.record, "aria-label", one === null ? t.recordings.recordOf(this.name) : t.recordings.stopOf(one.drones.join(", ")));
    setAttribute(this.record, "title", one?.reason || this.record.getAttribute("aria-label") || "");
    setAttribute(this.record, "aria-pressed", String(one !== null));
    setTone(this.record, one?.reason ? "bad" : "quiet");
  }

  /** The colours have changed. */
  repaint(): void {
    this.map.repaint();
    this.plots.repaint();
    this.scene?.repaint();
  }

  private build(): HTMLElement {
    const close = h("button", { type: "button", class: "bare close", "aria-label": t.pane.close(this.name), onclick: () => this.host.close(this.name) }, "×");
    const head = h("header", { class: "pane-head" }, this.title, this.hud.element, this.endReplay, this.pill, this.battery.element, this.full, this.record, this.panels, this.fly, close);
    const body = h("div", { class: "pane-body" }, this.stage.element, this.decks.space.element, this.instruments.element, this.decks.plots.element, this.decks.lists.element, this.channels.element);
    this.said.append(this.kind, this.fresh.element, this.ended, this.alarms.element, this.notice, this.alarms.chip);
    const element = h("article", { class: "pane", "data-drone": this.name, "aria-label": t.pane.drone(this.name), tabindex: -1 }, head, this.said, this.alarms.voice, body, this.thumbs.element, this.strip.element);
    element.addEventListener("pointerdown", () => this.host.select(this.name), { capture: true });
    element.addEventListener("focusin", () => this.host.select(this.name));
    return element;
  }

  private listener(): ConstructorParameters<typeof Pilot>[2] {
    return {
      changed: () => this.update(),
      refused: (command, why) => {
        if (command === "set" && [this.writes, this.parameters, this.controls.parameters].some((list) => list.refused(why))) return;
        if (command === "fly" && this.fresh.isOld) return; // the whole pane already shows that
        if (this.stage.followRefused(command, why)) return;
        this.notify(command ? t.commands.refused(named(t.commands.names, command), why) : why, "warn");
      },
      route: (progress) => (progress ? this.map.route.update(progress) : this.map.route.forget()),
      follow: (message) => (message ? this.stage.followed(message) : this.stage.forgetTarget()),
      done: (command, name, value) => {
        if (command === "set" && name !== undefined && value !== undefined && !this.writes.done(name)) for (const list of [this.parameters, this.controls.parameters]) list.done(name, value);
        if (command === "stop") this.notify(t.pane.stopShown, "bad");
        if (command === "goto") this.notify(t.pane.reached, "ok");
        if (command === "given" && name !== undefined) this.notify(t.pane.handedOver(name), "ok");
        if (command === "granted") this.notify(t.pane.granted, "ok");
      },
    };
  }

  private marking(): FollowHost {
    return {
      select: (camera) => this.pilot?.selectTarget(camera),
      mark: (mark) => this.pilot?.markTarget(mark),
      go: (mode, distance_m) => this.pilot?.flyAfter(mode, distance_m),
      stop: () => this.pilot?.stopFollowing(),
      notify: (text) => this.notify(text, "warn"),
    };
  }

  private linked(open: boolean, code: number): void {
    this.connected = open;
    this.wasConnected ||= open;
    if (open) this.events.restart(); // the drone may still be absent: the cockpit says so after it has accepted
    else this.miss(code === 4404 ? (this.isRecording ? t.pane.replayEnded : t.pane.gone(this.name)) : "");
    this.update();
  }

  /** Say why the drone is absent; "" if it is not known to be. */
  private miss(why: string): void {
    this.absent = why;
    this.bar?.end(why !== "");
    const ended = this.isRecording && why !== "";
    setHidden(this.ended, !ended);
    if (ended) for (const part of [this.endReplay, this.fresh.element]) setHidden(part, true);
  }

  private onMessage(message: Vehicle | State): void {
    if (message.type === "vehicle") {
      const first = this.vehicle === null;
      this.vehicle = message;
      if (first && this.target) this.host.known(this);
      this.stage.cameras(message.cameras);
      setHidden(this.endReplay, this.pilot === null || !message.uri.startsWith("replay:"));
      setAttribute(this.element, "data-recording", String(this.isRecording));
      this.map.watchOnly(this.isRecording);
      this.map.surroundings.reload();
      if (message.uri.startsWith("replay:")) this.openBar();
    } else {
      this.state = message;
      if (this.absent) this.miss("");
      this.fresh.received(message, this.isRecording);
      this.alarmBook.update(this.found(), performance.now()); // even if the page is hidden and nothing is drawn
      this.remember(message);
      this.events.add(message.events);
      if (message.events.some((event) => event.kind === "parameter_changed")) this.map.surroundings.reload();
    }
    this.dirty = true; // shown with the next tick
  }

  /** The time axis of plots and trail: a replay's own, which pauses and jumps with it. */
  private get moment_s(): number {
    return this.playback?.position_s ?? now_s();
  }

  private remember(state: State): void {
    const before_it = this.playback;
    this.playback = this.bar ? playbackOf(state.values) : null;
    // Zones and limits are those recorded up to that position.
    if (this.playback && momentOf(this.playback) !== (before_it && momentOf(before_it))) this.map.surroundings.reload();
    if (this.playback && this.playback.jumps !== before_it?.jumps) this.rebuild();
    else if (this.playback && this.playback.position_s === before_it?.position_s) return;
    this.history.add(this.moment_s, state.values);
    const place = state.position ?? state.truth?.position;
    if (place) this.trail.add(this.moment_s, place);
  }

  /** No line leads across a jump: plots and trail show the flight before, as far as known. */
  private rebuild(): void {
    this.history.clear();
    this.trail.clear();
    if (this.timeline === null) return;
    for (const { at_s, values, place } of before(this.timeline, this.moment_s, KEPT_S)) {
      this.history.add(at_s, values);
      if (place) this.trail.add(at_s, place);
    }
  }

  private openBar(): void {
    if (this.bar) return;
    this.bar = new ReplayBar(this.name, this.pilot !== null, {
      known: (timeline) => {
        this.timeline = timeline;
        if (this.playback) this.rebuild();
      },
      notify: (text) => this.notify(text, "warn"),
    });
    this.stage.append(this.bar.element);
  }

  private update(): void {
    this.dirty = false;
    const { state, vehicle, pilot, isRecording: recording } = this;
    const { isOld } = this.fresh;
    // Values from before a broken link are unknown; merely old ones are shown in grey.
    const live = this.connected && state?.links.application !== "lost" ? state : null;
    const over = recording && (live === null || live.links.vehicle === "closed");
    const title = vehicle ? titleOf(vehicle) : this.name;
    setText(this.title, title);
    setAttribute(this.title, "title", title);
    setText(this.kind, vehicle ? vehicle.description || vehicle.vehicle : "");
    const flight = live ? named(t.states, live.flight) : t.pane.unknown;
    const waking = live?.links.vehicle === "connecting" && live.flight === "unknown";
    setText(this.flight, waking ? t.waking : over ? t.pane.over : live && isOld ? t.pane.was(flight) : flight);
    setTone(this.pill, live && !isOld && !over ? (FLIGHT_TONES[live.flight] ?? "quiet") : "quiet");
    this.battery.show(live?.battery ?? null, live?.alarms ?? []);
    this.hud.update(live, this.connected && !isOld, pilot?.round_trip_s ?? null);
    this.instruments.update(live, this.connected && !isOld, pilot?.round_trip_s ?? null);
    if (live) this.channels.update(live);
    if (this.connected && state && !live) this.instruments.lost(state);
    this.stage.still(over ? t.replay.last : this.playback?.paused ? t.replay.paused : "");
    this.strip.update(vehicle, state, pilot, isOld, recording);
    if (this.renamed && pilot?.authority.state === "none") {
      this.renamed = false;
      this.control?.reopen();
    }
    const [mine, placed] = [(pilot?.mine ?? false) && !isOld && !recording, (live?.position ?? null) !== null];
    const inAir = live?.airborne ?? false;
    const nowhere = recording ? t.pane.recordingFlies : isOld ? t.pane.isOld : !placed ? t.pane.noPosition : !mine ? t.pane.takeToFly : t.pane.notInAir;
    this.map.allow(mine && placed && inAir ? "" : nowhere, mine ? "" : isOld ? t.pane.isOld : t.pane.takeForZones);
    this.stage.allowFollow(mine && inAir ? "" : recording ? t.pane.recordingFlies : isOld ? t.pane.isOld : mine ? t.follow.takeOff : t.follow.take);
    for (const list of [this.parameters, this.controls.parameters]) list.allow(mine, recording ? t.pane.asRecorded : t.pane.takeToChange);
    this.alarmBook.update(this.found(), performance.now());
    this.alarms.room = isOld && !this.absent ? 0 : 1;
    this.alarms.show();
    this.fresh.offer(this.alarmBook.open.some((alarm) => alarm.id === "old"));
    setAttribute(this.element, "data-absent", String(this.absent !== ""));
    setAttribute(this.element, "data-lost", String(!live || isOld));
    setAttribute(this.element, "data-old", String(isOld || (!live && !over)));
    setAttribute(this.element, "data-mine", String(mine));
    this.host.aimed(this.name);
  }

  /** The present problems: reported by the drone, and between the cockpit and this page. */
  private found(): Alarm[] {
    const { state } = this;
    if (this.isRecording && (!this.connected || state?.links.application === "lost" || state?.links.vehicle === "closed")) return []; // it is over
    const severity = state?.airborne || this.pilot?.mine ? "critical" : "warning";
    const old: Alarm[] = this.fresh.isOld ? [{ id: "old", severity, text: t.pane.shownIsOld }] : [];
    if (this.connected) return [...old, ...(state?.alarms ?? [])];
    if (!this.absent && old.length) return old; // the cause is the same
    if (this.absent) return [{ id: "absent", severity, text: this.absent }];
    if (!this.wasConnected && performance.now() - this.opened_ms < CONNECT_MS) return [];
    return [{ id: "page_link", severity, text: t.pane.noData(this.name) }];
  }

  notify(text: string, tone: Tone): void {
    setTone(this.notice, tone);
    setText(this.notice, text);
    this.noticed_ms = performance.now();
  }

  private async toggleRecord(): Promise<void> {
    setDisabled(this.record, true); // a second press would begin a second one
    await this.host.record(this);
    setDisabled(this.record, false);
  }

  private async stopReplay(): Promise<void> {
    try {
      await post(`/api/replays/${encodeURIComponent(this.name)}/stop`);
      this.host.close(this.name);
    } catch (error) {
      if (this.absent) return this.host.close(this.name); // ended elsewhere
      this.notify(errorText(error), "warn");
    }
  }

  private world(): Scene {
    const { state } = this;
    const { roll = null, pitch = null, yaw = null } = state?.attitude ?? {};
    const body = (name: string, position: Body["position"], turn: number | null): Body => ({ name, position, roll: 0, pitch: 0, yaw: turn });
    return {
      own: state?.position ? { ...body(this.name, state.position, yaw), roll: roll ?? 0, pitch: pitch ?? 0 } : null,
      truth: state?.truth ? { ...body("truth", state.truth.position, state.truth.yaw), roll: roll ?? 0, pitch: pitch ?? 0 } : null,
      others: othersOf({ name: this.name, recorded: this.isRecording }, this.host.rows()),
      targets: (state?.targets ?? []).map((target) => body(target.name, target.position, target.yaw)),
      waypoints: (state?.waypoints ?? []).map((one) => ({ position: one.position, own: one.app !== null })),
      trail: this.trail,
      world: this.map.surroundings.world,
      route: this.map.route.places,
      start: state?.start ?? null,
    };
  }

  private async openSpace(): Promise<void> {
    if (this.scene) return;
    try {
      const { SceneView } = await import("./scene.js");
      this.scene = new SceneView(() => this.world());
      this.space.append(this.scene.element);
    } catch (error) {
      this.space.replaceChildren(h("p", { class: "empty" }, t.pane.noSpace(errorText(error))));
    }
  }
}
