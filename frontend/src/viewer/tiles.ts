// Data that stands in script files, as a page from file:// may not fetch anything.

const waiting = new Map<string, (payload: unknown) => void>();
const loading = new Map<string, Promise<unknown>>();

declare global {
  var levkasTile: (key: string, payload: unknown) => void;
}

globalThis.levkasTile = (key, payload) => waiting.get(key)?.(payload);

/** Load a script file and return what it holds under `key`; rejects where it is not there. */
export function loadScript(address: string, key: string): Promise<unknown> {
  const same = loading.get(key);
  if (same) return same;
  const found = insert(address, key).finally(() => {
    waiting.delete(key);
    loading.delete(key);
  });
  loading.set(key, found);
  return found;
}

function insert(address: string, key: string): Promise<unknown> {
  return new Promise((resolve, reject) => {
    const script = document.createElement("script");
    waiting.set(key, resolve);
    script.async = true;
    script.src = address.split("/").map(encodeURIComponent).join("/");
    script.addEventListener("error", () => {
      script.remove();
      reject(new Error(`${address} cannot be read`));
    });
    script.addEventListener("load", () => {
      script.remove();
      reject(new Error(`${address} holds nothing under ${key}`)); // no effect where it does
    });
    document.head.append(script);
  });
}

/** Load a picture that a script file holds in base64; a page from file:// may read and save it, unlike a picture file. */
export async function loadPicture(key: string, format: string): Promise<HTMLImageElement> {
  const text = await loadScript(`${key}.js`, key);
  const image = new Image();
  image.src = `data:image/${format === "jpg" ? "jpeg" : format};base64,${String(text)}`;
  await image.decode();
  return image;
}

/** Base64 to bytes. */
export function toBytes(text: string): Uint8Array<ArrayBuffer> {
  const quick = Uint8Array as { fromBase64?: (text: string) => Uint8Array<ArrayBuffer> };
  if (quick.fromBase64) return quick.fromBase64(text);
  const raw = atob(text);
  const bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes;
}

/** Undo zlib. */
export async function inflate(bytes: Uint8Array<ArrayBuffer>): Promise<Uint8Array<ArrayBuffer>> {
  const { readable, writable } = new DecompressionStream("deflate");
  const writer = writable.getWriter();
  const written = writer.write(bytes).then(() => writer.close());
  const [whole] = await Promise.all([new Response(readable).arrayBuffer(), written]);
  return new Uint8Array(whole);
}
