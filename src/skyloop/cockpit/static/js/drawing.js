// Draws the shapes that controllers and processors published, over the picture that they belong to.

const rgb = ([red, green, blue]) => `rgb(${red} ${green} ${blue})`;

/** Draw one source's shapes; `scale` takes pixels of the frame to pixels of the canvas. */
export function draw(context, shapes, scale, density) {
  context.lineJoin = "round";
  context.lineCap = "round";
  for (const shape of shapes) {
    if (shape.kind === "line") line(context, shape, scale, density);
    else if (shape.kind === "points") points(context, shape, scale, density);
    else text(context, shape, scale, density);
  }
}

function line(context, shape, scale, density) {
  if (shape.points.length === 0) return;
  context.beginPath();
  shape.points.forEach(([x, y], index) => {
    const place = [(x + 0.5) * scale, (y + 0.5) * scale];
    if (index === 0) context.moveTo(...place);
    else context.lineTo(...place);
  });
  if (shape.closed) context.closePath();
  // A dark edge below keeps the line to be seen on any picture.
  context.strokeStyle = "rgb(0 0 0 / 55%)";
  context.lineWidth = 4.5 * density;
  context.stroke();
  context.strokeStyle = rgb(shape.colour);
  context.lineWidth = 2.25 * density;
  context.stroke();
}

function points(context, shape, scale, density) {
  for (const [x, y] of shape.points) {
    context.beginPath();
    context.arc((x + 0.5) * scale, (y + 0.5) * scale, 3.5 * density, 0, 2 * Math.PI);
    context.fillStyle = rgb(shape.colour);
    context.strokeStyle = "rgb(0 0 0 / 65%)";
    context.lineWidth = 1.5 * density;
    context.fill();
    context.stroke();
  }
}

function text(context, shape, scale, density) {
  context.font = `600 ${14 * density}px system-ui, sans-serif`;
  context.textBaseline = "middle";
  const width = context.measureText(shape.text).width;
  const inset = 8 * density;
  // Kept inside the picture, and below the row of the age and rate.
  const x = Math.max(inset, Math.min(shape.at[0] * scale, context.canvas.width - width - inset));
  const y = Math.max(50 * density, Math.min(shape.at[1] * scale, context.canvas.height - 16 * density));
  context.fillStyle = "rgb(6 10 15 / 68%)";
  context.beginPath();
  context.roundRect(x - inset, y - 12 * density, width + 2 * inset, 24 * density, 7 * density);
  context.fill();
  context.fillStyle = rgb(shape.colour);
  context.fillText(shape.text, x, y + density);
}
