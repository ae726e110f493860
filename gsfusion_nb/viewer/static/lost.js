// A sentence in place of silence: what to do when the kernel of a live view has gone.
const LOST = "This live view has no kernel any more: it was restarted or shut down. Run this cell again.";

/** Calls `tell(LOST)` when the kernel of the model goes, or is already gone; gives the function that ends it. */
export function whenLost(model, el, tell) {
  const gone = () => tell(LOST); // the line to Python is open when a view is made, so that this event closes it
  model.on("comm_live_update", gone);
  setTimeout(() => {
    if (el.closest(".jupyter-widgets-disconnected")) gone();
  });
  return () => model.off("comm_live_update", gone);
}
