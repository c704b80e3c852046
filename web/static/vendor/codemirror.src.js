// What codemirror.js in this folder is made from. To build it again:
//   npm install @codemirror/view@6.43.15 @codemirror/state@6.7.6 @codemirror/commands@6.11.1 \
//     @codemirror/autocomplete@6.20.4 @codemirror/lang-sql@6.10.0 @codemirror/language@6.13.1 \
//     @lezer/highlight@1.2.5 esbuild@0.28.2
//   npx esbuild codemirror.src.js --bundle --minify --format=esm --legal-comments=none \
//     --outfile=codemirror.js
import {EditorView, keymap, lineNumbers, highlightActiveLine, drawSelection, placeholder} from "@codemirror/view";
import {EditorState, Prec} from "@codemirror/state";
import {defaultKeymap, history, historyKeymap, indentWithTab} from "@codemirror/commands";
import {autocompletion, completionKeymap, closeBrackets, closeBracketsKeymap} from "@codemirror/autocomplete";
import {sql, PostgreSQL} from "@codemirror/lang-sql";
import {HighlightStyle, syntaxHighlighting, bracketMatching} from "@codemirror/language";
import {tags as t} from "@lezer/highlight";
const style = HighlightStyle.define([
  {tag: t.keyword, color: "var(--code-keyword)", fontWeight: "500"},
  {tag: [t.string, t.special(t.string)], color: "var(--code-string)"},
  {tag: [t.number, t.bool, t.null], color: "var(--code-number)"},
  {tag: [t.comment, t.lineComment, t.blockComment], color: "var(--text-faint)", fontStyle: "italic"},
  {tag: t.typeName, color: "var(--code-type)"},
]);
const theme = EditorView.theme({
  "&": {backgroundColor: "var(--sunken)", color: "var(--text)", fontSize: "14px"},
  "&.cm-focused": {outline: "none"},
  ".cm-scroller": {fontFamily: "var(--mono)", lineHeight: "1.6", minHeight: "11rem", maxHeight: "28rem"},
  ".cm-content": {caretColor: "var(--text)", padding: "0.75rem 0"},
  ".cm-cursor": {borderLeftColor: "var(--text)"},
  ".cm-gutters": {backgroundColor: "transparent", color: "var(--text-faint)", border: "none", paddingLeft: "0.5rem"},
  ".cm-activeLine": {backgroundColor: "transparent"},
  "&.cm-focused .cm-selectionBackground, .cm-selectionBackground": {backgroundColor: "var(--selection) !important"},
  ".cm-tooltip": {backgroundColor: "var(--raised)", color: "var(--text)", border: "1px solid var(--line)", borderRadius: "6px", overflow: "hidden"},
  ".cm-tooltip-autocomplete ul li": {fontFamily: "var(--mono)", padding: "2px 8px"},
  ".cm-tooltip-autocomplete ul li[aria-selected]": {backgroundColor: "var(--accent)", color: "var(--on-accent)"},
  ".cm-matchingBracket": {backgroundColor: "var(--selection)", outline: "none"},
});
export function createEditor({parent, text, schema, label, onRun}) {
  const run = () => { onRun(); return true; };
  // A shadow root: there CodeMirror's styles need no inline style element, which the policy forbids
  const root = parent.appendChild(document.createElement("div")).attachShadow({ mode: "open" });
  return new EditorView({
    parent: root,
    root,
    state: EditorState.create({doc: text, extensions: [
      Prec.highest(keymap.of([{key: "Mod-Enter", run}])),
      lineNumbers(), history(), drawSelection(), bracketMatching(), closeBrackets(), autocompletion(),
      highlightActiveLine(), EditorView.lineWrapping,
      keymap.of([...closeBracketsKeymap, ...completionKeymap, ...defaultKeymap, ...historyKeymap, indentWithTab]),
      sql({dialect: PostgreSQL, schema}), syntaxHighlighting(style), theme,
      EditorView.contentAttributes.of({"aria-label": label}),
    ]}),
  });
}
