// A drone's scenery and limits: read once per connection, and again after a parameter was written.

import { get } from "./api.js";
import type { Vector } from "./model.js";

export interface Thing {
  name: string;
  position: Vector;
  yaw: number;
}

export type Zone = { name?: string } & ({ kind: "box"; low: Vector; high: Vector } | { kind: "cylinder"; centre: [number, number]; radius: number; low: number; high: number });

type Ends = [number | null, number | null, number | null];

/** The safety box; a null wall is absent. */
export interface SafetyBox {
  low: Ends;
  high: Ends;
}

export interface CameraView {
  name: string;
  position: Vector | null;
  /** Through the corners of its pictures, in body axes; null if its lens or mounting is unknown. */
  rays: Vector[] | null;
}

export interface World {
  name: string;
  /** The source: the drone, or the cockpit's file; null if there is none. */
  source: "vehicle" | "file" | null;
  room: { low: Vector; high: Vector; enclosed: boolean } | null;
  solids: (Thing & { size: Vector })[];
  gates: (Thing & { size: [number, number]; frame: number })[];
  markers: (Thing & { size: number; elevation: number })[];
  starts: Thing[];
  left_out: number;
  box: SafetyBox | null;
  zones: Zone[];
  limits: { speed: number | null; climb: number | null; altitude: number | null };
  cameras: CameraView[];
}

const AGAIN_MS = 150; // pause before a read, to join several requests
const RETRY_MS = 3000; // pause after a failed read

export class Surroundings {
  /** null until it was read. */
  world: World | null = null;
  private waiting: ReturnType<typeof setTimeout> | null = null;
  private closed = false;

  constructor(
    private readonly drone: string,
    private readonly changed: () => void,
  ) {}

  /** Read it soon: several calls at about the same time count as one. */
  reload(after_ms = AGAIN_MS): void {
    if (this.waiting !== null) clearTimeout(this.waiting);
    this.waiting = setTimeout(() => void this.load(), after_ms);
  }

  close(): void {
    this.closed = true;
    if (this.waiting !== null) clearTimeout(this.waiting);
  }

  /** The reason why the drone may not fly straight to a place; empty if none is known. */
  async problem(place: Vector): Promise<string> {
    try {
      return (await get<{ problem: string }>(`${this.path}/way?to=${place.join(",")}`)).problem;
    } catch {
      return ""; // the drone checks it too
    }
  }

  private get path(): string {
    return `/api/drones/${encodeURIComponent(this.drone)}`;
  }

  private async load(): Promise<void> {
    this.waiting = null;
    try {
      this.world = await get<World>(`${this.path}/world`);
      this.changed();
    } catch {
      if (!this.closed) this.reload(RETRY_MS);
    }
  }
}
