// All words of the page, in English. A translation has the same names and takes the same values.

export const en = {
  modal: { close: "Close" },
  settings: {
    title: "Settings",
    note: "Remembered by this browser, for all of its tabs.",
    theme: "Colours",
    themes: { system: "As the system", dark: "Dark", light: "Light" },
    units: "Units",
    unit: { metric: "Metric", imperial: "Imperial" },
    unitsNote: "Of what is shown. Parameters and recordings keep SI units.",
    sound: "Sound of alarms",
    sounds: { on: "On", off: "Muted" },
    mode: "Sticks",
    modes: { "1": "Mode 1", "2": "Mode 2", "3": "Mode 3", "4": "Mode 4" },
    modeNote: (left: string, right: string) => `Left stick: ${left}. Right stick: ${right}. For gamepads and on a touch screen.`,
    stick: { forward: "forward and back", left: "left and right", up: "up and down", yaw_rate: "turn" },
    and: (one: string, other: string) => `${one}, ${other}`,
    language: "Language",
    languageNote: "Used when the page is loaded again.",
  },
} as const;
