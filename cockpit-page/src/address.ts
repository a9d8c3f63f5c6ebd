// The drones that the page shows, from its address: `#alpha,beta` shows these two, `#/` shows all. Pure.

/** The address of the overview; no drone can have this name. */
export const OVERVIEW = "#/";

/** The drones that an address names; none for the overview. */
export function namesOf(hash: string): string[] {
  const text = hash.replace(/^#/, "");
  if (text.startsWith("/")) return [];
  const names = text.split(",").map((name) => {
    try {
      return decodeURIComponent(name);
    } catch {
      return name; // typed by hand
    }
  });
  return [...new Set(names.filter(Boolean))];
}

export const hashOf = (names: readonly string[]): string => (names.length ? `#${names.map(encodeURIComponent).join(",")}` : OVERVIEW);
