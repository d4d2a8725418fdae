// Starts Rerun's web viewer on the recording beside this page. Nothing is stored in the browser, nobody else is asked.
const canvas = document.getElementById("viewer");
const told = document.getElementById("told");
const RETRY_MS = 200;
const TRIES = 1500; // five minutes

function tell(text) {
  told.textContent = text;
  told.hidden = !text;
}

function varint(number) {
  const bytes = [];
  let rest = BigInt(number);
  for (; rest > 127n; rest >>= 7n) bytes.push(Number(rest & 127n) | 128);
  return [...bytes, Number(rest)];
}

function field(number, content) {
  return [(number << 3) | 2, ...varint(content.length), ...content];
}

// A ViewerControlRequest of Rerun 0.41 (viewer_control.proto) that sets the time cursor and pauses there.
function setTime(timeline, ns) {
  const name = field(1, [...new TextEncoder().encode(timeline)]);
  const time = [1 << 3, ...varint(ns)];
  const paused = [5 << 3, 1];
  return new Uint8Array(field(6, [...field(2, name), ...field(3, time), ...paused]));
}

// Until the recording has come, however slow the line, the viewer refuses to move a cursor in it.
async function jump(handle) {
  if (canvas.dataset.atNs === "") return;
  for (let left = TRIES; ; left--) {
    try {
      await handle.viewer_control(setTime("elapsed", canvas.dataset.atNs));
      return;
    } catch (error) {
      if (left === 0) throw error;
      await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
    }
  }
}

function watch(handle) {
  const timer = setInterval(() => {
    if (!handle.has_panicked()) return;
    clearInterval(timer);
    canvas.hidden = true;
    tell(`The viewer stopped: ${handle.panic_message()}`);
  }, 1000);
}

async function start() {
  if (location.protocol === "file:") {
    throw new Error("a browser does not load this from a file. In this folder, run: python -m http.server --bind 127.0.0.1");
  }
  const asked = new URLSearchParams(location.search);
  await wasm_bindgen({ module_or_path: "re_viewer_bg.wasm" });
  const handle = new wasm_bindgen.WebHandle({
    url: canvas.dataset.recording.split(" ").map((url) => new URL(url, document.baseURI).href),
    hide_welcome_screen: true,
    enable_history: false,
    notebook: false,
    persist: false,
    render_backend: asked.get("renderer"),
    theme: asked.get("theme") ?? "system",
  });
  canvas.hidden = false;
  await handle.start(canvas);
  tell("");
  watch(handle);
  jump(handle).catch((error) => console.warn(`The cursor cannot be set: ${error.message}`));
}

start().catch((error) => tell(`The viewer did not start: ${error.message ?? error}`));
