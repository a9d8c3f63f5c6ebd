// Who searches for a symptom is looking for its remedy: those pages come before the ones that explain.
var Scorer = {
  score: ([docname, title, anchor, descr, score, filename]) =>
    score + ({ troubleshooting: 40, faq: 15 }[docname] ?? (docname.startsWith("start/") ? 5 : 0)),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
