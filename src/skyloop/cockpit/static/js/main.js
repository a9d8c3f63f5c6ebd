// Puts the page together: asks which drones there are, then watches one of them.

import { Attitude } from "./attitude.js";
import { byId, setText } from "./dom.js";
import { Channels, Events } from "./lists.js";
import { LastingSocket } from "./socket.js";
import { Status } from "./status.js";
import { startTheme } from "./theme.js";
import { Video } from "./video.js";

class Page {
  constructor() {
    this.status = new Status();
    this.attitude = new Attitude();
    this.events = new Events();
    this.channels = new Channels();
    this.video = new Video();
  }

  watch(name) {
    this.name = name;
    const path = `/ws/drones/${encodeURIComponent(name)}/telemetry`;
    this.telemetry = new LastingSocket(path, {
      message: (data) => this.take(JSON.parse(data)),
      state: (open) => this.status.setConnected(open),
    });
  }

  take(message) {
    if (message.type === "vehicle") {
      this.meet(message);
      return;
    }
    this.status.update(message);
    this.attitude.update(message.feedback);
    this.channels.update(message.channels);
    this.events.add(message.events);
  }

  /** Comes first on every connection; events are told anew from the start then. */
  meet(vehicle) {
    document.title = `${vehicle.name} · Skyloop cockpit`;
    setText(byId("drone-name"), vehicle.name);
    setText(byId("drone-kind"), vehicle.can_fly ? vehicle.uri : `${vehicle.uri} · can't fly: ${vehicle.why_not}`);
    this.status.flies = vehicle.can_fly;
    this.events.clear();
    if (this.video.camera || vehicle.cameras.length === 0) return;
    this.offer(vehicle.cameras.map((camera) => camera.name));
  }

  offer(cameras) {
    const buttons = cameras.map((camera) => {
      const button = document.createElement("button");
      button.type = "button";
      button.className = "quiet";
      button.textContent = camera;
      button.addEventListener("click", () => choose(camera));
      return button;
    });
    const choose = (camera) => {
      cameras.forEach((name, index) => buttons[index].setAttribute("aria-pressed", String(name === camera)));
      this.video.watch(this.name, camera);
    };
    byId("cameras").replaceChildren(...buttons);
    choose(cameras[0]);
  }
}

async function firstDrone() {
  for (;;) {
    try {
      const drones = await (await fetch("/api/drones")).json();
      if (drones.length) return drones[0].name;
    } catch {
      // The cockpit is starting or gone: ask again.
    }
    await new Promise((resolve) => setTimeout(resolve, 500));
  }
}

startTheme();
new Page().watch(await firstDrone());
