// Finds texts on the page that are not in the language file: `npm run check` fails on them.

import fs from "node:fs";
import path from "node:path";
import ts from "typescript";

/** Attributes of elements that people read; all others are for the browser. */
const READ = new Set(["aria-label", "aria-description", "aria-valuetext", "aria-roledescription", "title", "placeholder", "alt", "label"]);
/** Calls whose strings are names: of elements, events, styles, and stored values. */
const NAMES = new Set(["querySelector", "querySelectorAll", "getElementById", "addEventListener", "removeEventListener", "setProperty", "getPropertyValue", "getContext", "createElement", "createElementNS", "closest", "matches", "get", "set", "on", "has", "unique", "colour", "startsWith", "endsWith", "includes", "toBlob", "isTypeSupported", "matchMedia", "replaceAll", "replace", "split", "join", "fetch", "setTone", "removeProperty", "getAttribute", "removeAttribute", "removeItem", "getItem", "setItem"]);
/** Functions that create elements, and where their children begin. */
const MAKERS = { h: 2, svg: 2, holdButton: 3 };
/** Names of keys, fonts, media queries and selectors. */
const TECHNICAL = /^Skyloop$|^(Arrow|Numpad|Digit|Control\+)|px (system-ui|sans-serif)|^\((pointer|orientation|prefers)|\[\w+\]$/;
const SENTENCE = /\p{L}[,;:.…?!]? +[\p{L}“(]|^\p{Lu}\p{Ll}/u;
const WORD = /\p{L}{2}/u;

/** The literals of a source that look like text for people: `[{line, text, node}]`. */
export function wordsIn(name, text) {
  const source = ts.createSourceFile(name, text, ts.ScriptTarget.ES2022, true);
  const found = [];
  const visit = (node) => {
    if (ts.isImportDeclaration(node) || ts.isTypeNode(node) || ts.isInterfaceDeclaration(node) || ts.isTypeAliasDeclaration(node)) return;
    if (ts.isStringLiteralLike(node) || ts.isTemplateExpression(node)) {
      if (isShown(node)) found.push({ line: source.getLineAndCharacterOfPosition(node.getStart()).line + 1, text: node.getText(), node });
      if (!ts.isTemplateExpression(node)) return;
    }
    ts.forEachChild(node, visit);
  };
  visit(source);
  return found;
}

const textOf = (node) => (ts.isTemplateExpression(node) ? node.head.text + node.templateSpans.map((span) => `\u0001${span.literal.text}`).join("") : node.text);

function isShown(node) {
  const text = textOf(node);
  if (!WORD.test(text) || TECHNICAL.test(text)) return false;
  const place = placeOf(node);
  if (place === "name") return false;
  return place === "shown" || SENTENCE.test(text);
}

/** The use of a literal: surely "shown" to people, surely a "name", or null: decided by its look. */
function placeOf(node) {
  const parent = node.parent;
  if (ts.isParenthesizedExpression(parent) || ts.isAsExpression(parent) || ts.isNonNullExpression(parent)) return placeOf(parent);
  if (ts.isConditionalExpression(parent)) return parent.condition === node ? "name" : placeOf(parent);
  if (ts.isBinaryExpression(parent)) {
    const operator = parent.operatorToken.kind;
    if (operator === ts.SyntaxKind.PlusToken || operator === ts.SyntaxKind.QuestionQuestionToken || operator === ts.SyntaxKind.BarBarToken) return placeOf(parent);
    return operator === ts.SyntaxKind.EqualsToken ? null : "name";
  }
  if (ts.isTemplateSpan(parent)) return placeOf(parent.parent);
  if (ts.isPropertyAssignment(parent)) {
    if (parent.name === node) return "name";
    const name = ts.isStringLiteralLike(parent.name) || ts.isIdentifier(parent.name) ? parent.name.text : "";
    const call = parent.parent.parent;
    if (READ.has(name)) return "shown";
    return name === "class" || (ts.isCallExpression(call) && call.expression.getText() in MAKERS) ? "name" : null;
  }
  if (ts.isArrayLiteralExpression(parent) && ts.isNewExpression(parent.parent) && parent.parent.expression.getText() === "Set") return "name";
  if (ts.isElementAccessExpression(parent) || ts.isCaseClause(parent) || ts.isLiteralTypeNode(parent)) return "name";
  if (ts.isCallExpression(parent) || ts.isNewExpression(parent)) {
    const called = parent.expression.getText();
    const place = (parent.arguments ?? []).indexOf(node);
    // Commands are the same in every language, and a RangeError is for developers.
    if (called === "RangeError" || (called === "h" && parent.arguments[0].text === "code")) return "name";
    if (called in MAKERS) return place >= MAKERS[called] ? "shown" : "name";
    if (called === "setText") return "shown";
    if (called === "setAttribute") return place === 2 && READ.has(parent.arguments[1].text) ? "shown" : "name";
    const last = called.slice(called.lastIndexOf(".") + 1);
    if (NAMES.has(last)) return "name";
    return null;
  }
  return null;
}

/** The sources outside of the language files. */
export function sources(folder) {
  return fs.readdirSync(folder, { withFileTypes: true }).filter((entry) => entry.isFile() && entry.name.endsWith(".ts")).map((entry) => path.join(folder, entry.name));
}

if (import.meta.filename === path.resolve(process.argv[1] ?? "")) {
  const folder = path.join(import.meta.dirname, "src");
  const literals = sources(folder).flatMap((file) => wordsIn(file, fs.readFileSync(file, "utf8")).map((each) => `${path.relative(import.meta.dirname, file)}:${each.line}: ${each.text}`));
  for (const line of literals) console.error(line);
  if (literals.length) {
    console.error(`${literals.length} texts are outside of src/language/en.ts: move them there (t.…)`);
    process.exitCode = 1;
  }
}
