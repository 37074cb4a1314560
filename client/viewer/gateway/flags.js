// The command line of the gateway.
import { defaultProtoFolder } from './proto.js';

export const help = `Shows a running Aureole world, or recordings, in a browser.
Usage: node gateway.js --server HOST:PORT [OPTIONS]

  --server HOST:PORT     Any region server of the world; aureole up names them. May be left out with --recordings
  --listen HOST:PORT     Where browsers find the viewer; port 0: any free one. 127.0.0.1:0 when not given
  --recordings DIR       Offer the *.mcap files of this folder
  --allow-host NAME      Also answer to this host name, such as that of a proxy in front. May be repeated
  --proto DIR            The interface files; those of the repository when not given
  --exit-with-stdin      End when standard input ends
  --help                 Print this help and exit

Prints "viewer: http://HOST:PORT/" when it is ready. It listens on this machine alone unless told otherwise: whoever
reaches it may push, add and remove bodies.

Exit codes: 0 ended by a signal or by standard input; 1 it could not start; 2 bad flags.
`;

export class BadFlags extends Error {}

// "host:port", with brackets around an IPv6 host, as { host, port }.
export function parseAddress(text, flag) {
  const match = /^(?:\[([0-9a-fA-F:.]+)\]|([^:[\]/@\s]+)):(\d{1,5})$/.exec(text);
  if (match === null || Number(match[3]) > 65535) throw new BadFlags(`${flag}: must be HOST:PORT (is ${text})`);
  return { host: match[1] ?? match[2], port: Number(match[3]) };
}

// Throws BadFlags with a message for the user.
export function parseFlags(argv) {
  const options = {
    server: '', listen: { host: '127.0.0.1', port: 0 }, recordings: '', proto: defaultProtoFolder,
    allowedHosts: [], exitWithStdin: false, help: false,
  };
  for (let i = 0; i < argv.length; ++i) {
    const [flag, given] = splitFlag(argv[i]);
    const value = () => {
      const out = given ?? argv[++i];
      if (out === undefined || out === '') throw new BadFlags(`${flag}: needs a value`);
      return out;
    };
    if (flag === '--server') {
      options.server = value();
      if (parseAddress(options.server, flag).port === 0) throw new BadFlags('--server: must name a port');
    } else if (flag === '--listen') options.listen = parseAddress(value(), flag);
    else if (flag === '--recordings') options.recordings = value();
    else if (flag === '--allow-host') options.allowedHosts.push(value());
    else if (flag === '--proto') options.proto = value();
    else if (flag === '--exit-with-stdin') options.exitWithStdin = true;
    else if (flag === '--help' || flag === '-h') options.help = true;
    else throw new BadFlags(`${argv[i]}: no such flag; see --help`);
  }
  if (options.server === '' && options.recordings === '' && !options.help) {
    throw new BadFlags('--server: give one, or --recordings; see --help');
  }
  return options;
}

function splitFlag(argument) {
  const at = argument.indexOf('=');
  return argument.startsWith('--') && at > 0 ? [argument.slice(0, at), argument.slice(at + 1)] : [argument, undefined];
}
