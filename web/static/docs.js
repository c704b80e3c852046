// The page of the interface: Swagger UI on our own description, in the theme of the page.
const root = document.documentElement;
const place = document.getElementById("reference");
const follow = () => root.classList.toggle("dark-mode", root.dataset.theme === "dark");

// A path is inside the button that opens its operation: as text, not as a second control
const plainPaths = (system) => ({
  wrapComponents: {
    DeepLink: () => ({ text }) => system.React.createElement("span", null, text),
  },
});

follow();
document.addEventListener("themechange", follow);
SwaggerUIBundle({
  domNode: place,
  url: place.dataset.description,
  deepLinking: true,
  docExpansion: "list",
  defaultModelsExpandDepth: 0,
  displayRequestDuration: true,
  filter: true,
  tryItOutEnabled: false,
  plugins: [plainPaths],
  validatorUrl: null, // nothing is sent to another host
});
