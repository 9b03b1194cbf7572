// Data that stands in script files, as a page from file:// may not fetch anything.

const waiting = new Map<string, (payload: unknown) => void>();

declare global {
  var levkasTile: (key: string, payload: unknown) => void;
}

globalThis.levkasTile = (key, payload) => waiting.get(key)?.(payload);

/** Load a script file and return what it holds under `key`; rejects where it is not there. */
export function loadScript(address: string, key: string): Promise<unknown> {
  return new Promise((resolve, reject) => {
    const script = document.createElement("script");
    waiting.set(key, resolve);
    script.async = true;
    script.src = address.split("/").map(encodeURIComponent).join("/");
    script.addEventListener("error", () => reject(new Error(`${address} cannot be read`)));
    script.addEventListener("load", () => {
      script.remove();
      waiting.delete(key);
      reject(new Error(`${address} holds nothing under ${key}`)); // no effect where it does
    });
    document.head.append(script);
  });
}

/** Base64 to bytes. */
export function toBytes(text: string): Uint8Array<ArrayBuffer> {
  const raw = atob(text);
  const bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes;
}

/** Undo zlib. */
export async function inflate(bytes: Uint8Array<ArrayBuffer>): Promise<Uint8Array<ArrayBuffer>> {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}
