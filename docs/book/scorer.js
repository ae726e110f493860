// The order of the search's results. What a page or heading is called counts most, for every word that is looked for;
// of equals, chapters come first, in their order, then the documentation, then questions of the quiz, then the API.
const bonus = (docname) => {
  const chapter = docname.match(/^notebooks\/(\d+)/);
  if (chapter) return 4 - Number(chapter[1]) / 100;
  if (docname.startsWith("notebooks/")) return 3.5;
  if (docname.startsWith("docs/teaching/quiz/")) return -14;
  return docname.startsWith("api/") || docname.startsWith("_modules/") ? -12 : 2;
};
const HEADING = 6;
const PAGE_TITLE = 6;

/** Points of a page for the words of the search that its headings have, and again for those of its title. */
const named = (docname) => {
  const index = Search._index;
  const page = index.docnames.indexOf(docname);
  const stemmer = new Stemmer();
  const stems = (text) => new Set(splitQuery(text.toLowerCase()).map((word) => stemmer.stemWord(word)));
  const title = stems(index.titles[page]);
  const looked = stems(new URLSearchParams(window.location.search).get("q") ?? "");
  let points = 0;
  for (const word of looked) {
    const pages = Object.hasOwn(index.titleterms, word) ? [index.titleterms[word]].flat() : [];
    points += (pages.includes(page) ? HEADING : 0) + (title.has(word) ? PAGE_TITLE : 0);
  }
  return points / Math.max(looked.size, 1);
};

var Scorer = {
  score: ([docname, , anchor, , score]) => score + bonus(docname) + (anchor ? 0 : named(docname)),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
