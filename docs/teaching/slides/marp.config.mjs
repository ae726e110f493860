// Nothing is loaded from another server: no emoji pictures, formulas are drawn when the deck is built.
export default {
  themeSet: ['theme.css'],
  html: true,
  options: { emoji: { shortcode: false, unicode: false }, math: 'mathjax' },
}
