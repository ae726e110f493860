// Opens each panel of the page when it is nearly seen: its own script and numbers come then.
const folder = document.currentScript.src.replace(/[^/]*$/, "");
const near = new IntersectionObserver(
  (entries) => {
    for (const { target, isIntersecting } of entries) {
      if (!isIntersecting) continue;
      near.unobserve(target);
      document.head.append(create("script", { src: `${folder}live_${target.dataset.live}.js` }));
    }
  },
  { rootMargin: "300px" },
);
document.querySelectorAll(".gsnb-live").forEach((section) => near.observe(section));
