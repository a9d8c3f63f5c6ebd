// Requests over HTTP.

import { t } from "./language/index.js";

export class Refused extends Error {}

async function answered(response: Response): Promise<unknown> {
  const text = (await response.text()) || "{}";
  const isJson = response.headers.get("content-type")?.startsWith("application/json") ?? false;
  const values = isJson ? (JSON.parse(text) as { error?: string }) : { error: text };
  if (!response.ok) throw new Refused(values.error ?? t.api.refused(response.status));
  return values;
}

async function ask(path: string, options: RequestInit): Promise<unknown> {
  try {
    return await answered(await fetch(path, options));
  } catch (error) {
    if (error instanceof Refused) throw error;
    throw new Refused(t.api.silent);
  }
}

/** Throws Refused with the server's message. */
export const get = async <T>(path: string): Promise<T> => (await ask(path, {})) as T;

/** Throws Refused with the server's message. */
export const post = async <T>(path: string, values: object = {}): Promise<T> =>
  (await ask(path, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(values) })) as T;

export const errorText = (error: unknown): string => (error instanceof Error ? error.message : String(error));
