// The page of the interface: Swagger UI on our own description, in the theme of the page.
const root = document.documentElement;
const place = document.getElementById("reference");
const follow = () => root.classList.toggle("dark-mode", root.dataset.theme === "dark");

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
  validatorUrl: null, // nothing is sent to another host
});
