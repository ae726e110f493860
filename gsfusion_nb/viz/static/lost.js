// A sentence in place of silence: what to do when the kernel of a live view has gone.
const LOST = "This live view has no kernel any more: it was restarted or shut down. Run this cell again.";

/** Calls `tell(LOST)` when the kernel of the model has gone; gives the function that ends it. */
export function whenLost(model, el, tell) {
  const look = () => {
    if (el.isConnected && el.closest(".jupyter-widgets-disconnected")) tell(LOST);
  };
  const later = () => setTimeout(look); // the page marks its views after this event
  model.on("comm_live_update", later);
  later();
  return () => model.off("comm_live_update", later);
}
