// The documentation, from the API's own document. Everything shown goes in as text, never as markup.
const make = (tag, text, ...children) => {
  const element = document.createElement(tag);
  if (text) element.textContent = text;
  element.append(...children);
  return element;
};

function prose(text) { // `code` between backquotes, the rest as it is
  return make("span", "", ...(text || "").split("`").map((part, i) => (i % 2 ? make("code", part) : part)));
}

function kind(schema) {
  if (!schema) return "";
  if (schema.$ref) return schema.$ref.split("/").pop();
  if (schema.anyOf) return schema.anyOf.map(kind).join(" or ");
  if (schema.enum) return schema.enum.join(" | ");
  if ("const" in schema) return JSON.stringify(schema.const);
  if (schema.type === "array") return `list of ${kind(schema.items)}`;
  const limits = [["minimum", "≥"], ["maximum", "≤"], ["exclusiveMinimum", ">"], ["exclusiveMaximum", "<"]]
    .filter(([name]) => name in schema).map(([name, sign]) => `${sign} ${schema[name]}`);
  return [schema.type || "", ...limits].join(" ");
}

function table(rows) {
  return make("table", "", ...rows.map((cells) => make("tr", "", ...cells.map((cell) => make("td", "", cell)))));
}

const named = (name, required) => make("code", required ? `${name} *` : name);

function fields(schema) {
  return table(Object.entries(schema.properties || {}).map(([name, field]) => [
    named(name, (schema.required || []).includes(name)), kind(field), prose(field.description),
  ]));
}

function operation(method, path, item) {
  const details = make("details", "", make("summary", "", make("b", method.toUpperCase()), ` ${path}`));
  details.id = item.operationId;
  details.append(make("p", "", prose(item.description)));
  if (item.parameters) {
    details.append(make("h4", "Parameters"), table(item.parameters.map((p) => [
      named(p.name, p.required), p.in, kind(p.schema), prose(p.description || p.schema.description),
    ])));
  }
  for (const [type, { schema }] of Object.entries(item.requestBody?.content || {})) {
    details.append(make("h4", `Body: ${type} ${schema?.$ref ? kind(schema) : ""}`), schema ? fields(schema) : "");
  }
  details.append(make("h4", "Answers"), table(Object.entries(item.responses).map(([status, answer]) => [
    make("code", status), Object.entries(answer.content || {}).map(([type, c]) => kind(c.schema) || type).join(", "),
    prose(answer.description),
  ])));
  return details;
}

const api = await (await fetch("/openapi.json")).json();
document.getElementById("summary").textContent = `${api.info.title} ${api.info.version}. ${api.info.summary}`;
for (const [path, methods] of Object.entries(api.paths)) {
  for (const [method, item] of Object.entries(methods)) {
    document.getElementById("operations").append(operation(method, path, item));
  }
}
for (const [name, schema] of Object.entries(api.components.schemas).sort()) {
  const details = make("details", "", make("summary", name), make("p", "", prose(schema.description)));
  details.append(schema.enum ? make("p", schema.enum.join(", ")) : fields(schema));
  document.getElementById("types").append(details);
}
if (location.hash) document.getElementById(location.hash.slice(1))?.setAttribute("open", "");
