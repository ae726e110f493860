// Where the engine runs: in a worker made from its own text, or in the page where a worker is not allowed.

/** `post(message, transfer)` and `close()`; replies arrive at `onReply`. `onRestart`: the engine is new and empty. */
export function startEngine(source, onReply, onRestart) {
  let post = null;
  let worker = null;
  const local = () => {
    worker = null;
    const engine = new Engine();
    post = (message) => setTimeout(() => onReply(engine.handle(message)[0]));
  };
  try {
    const loop = "\nconst engine = new Engine();\nonmessage = (e) => postMessage(...engine.handle(e.data));";
    const url = URL.createObjectURL(new Blob([source + loop], { type: "text/javascript" }));
    worker = new Worker(url);
    worker.onmessage = (e) => onReply(e.data);
    worker.onerror = (e) => {
      e.preventDefault();
      console.warn("the splat viewer's worker failed, drawing in the page instead:", e.message);
      local();
      onRestart();
    };
    post = (message, transfer = []) => worker.postMessage(message, transfer);
  } catch (error) {
    console.warn("no worker for the splat viewer, drawing in the page instead:", error);
    local();
  }
  return { post: (...message) => post(...message), close: () => worker?.terminate() };
}
