// Flies an AR.Drone with the npm package ar-drone alone: node fly_ar_drone.js HOST
// Writes what it saw as one line of JSON. The package is found by NODE_PATH.
'use strict';

const arDrone = require('ar-drone');
const PaVEParser = require('ar-drone/lib/video/PaVEParser');

const PATIENCE_MS = 60000;
const host = process.argv[2];
const client = arDrone.createClient({ip: host});
const saw = {
  navdata: 0, options: [], battery: null, errors: [], states: [],
  fastest: 0, highest: 0, config: [], frames: 0, keyFrames: 0, bytes: 0, sizes: [],
};

function end(code, why) {
  if (why) console.error(why);
  console.log(JSON.stringify(saw));
  process.exit(code);
}
setTimeout(() => end(1, 'it took too long'), PATIENCE_MS);

client.on('error', (error) => saw.errors.push(String(error)));
client.on('navdata', (navdata) => {
  saw.navdata += 1;
  for (const name of Object.keys(navdata)) if (!saw.options.includes(name)) saw.options.push(name);
  if (!navdata.demo) return;
  saw.battery = navdata.demo.batteryPercentage;
  saw.fastest = Math.max(saw.fastest, navdata.demo.velocity.x);
  saw.highest = Math.max(saw.highest, navdata.demo.altitude);
  const state = navdata.demo.controlState;
  if (saw.states[saw.states.length - 1] !== state) saw.states.push(state);
});

const parser = new PaVEParser();
parser.on('error', (error) => saw.errors.push(String(error)));
parser.on('data', (frame) => {
  saw.frames += 1;
  saw.bytes += frame.payload.length;
  if (frame.frame_type === 1) saw.keyFrames += 1;
  const size = frame.display_width + 'x' + frame.display_height;
  if (!saw.sizes.includes(size)) saw.sizes.push(size);
});
client.getVideoStream().on('data', (data) => parser.write(data));

function config(key, value, next) {
  client.config(key, value, (error) => {
    saw.config.push([key, error ? String(error) : 'acknowledged']);
    if (error) return end(1, key + ': ' + error);
    next();
  });
}

// Take-off, full navdata on the way, forward, hover, land.
client.once('navdata', () => config('control:altitude_max', '2000', () => client.takeoff(() => {
  config('general:navdata_demo', 'FALSE', () => {
    client.front(0.3);
    client.after(1500, function() { this.stop(); })
      .after(1500, function() { this.land(() => end(0)); });
  });
})));
