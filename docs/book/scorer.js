// The order of the search's results. What a page or heading is called counts most; of equals, chapters come first, in
// their order, then the documentation, then the API.
const bonus = (docname) => {
  const chapter = docname.match(/^notebooks\/(\d+)/);
  if (chapter) return 4 - Number(chapter[1]) / 100;
  return docname.startsWith("notebooks/") ? 3.5 : docname.startsWith("api/") || docname.startsWith("_modules/") ? -12 : 2;
};
var Scorer = {
  score: ([docname, , , , score]) => score + bonus(docname),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
