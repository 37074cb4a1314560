#include "client/cli/completion.h"

#include <iostream>
#include <vector>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_join.h>
#include <absl/strings/str_replace.h>

#include "client/cli/exit_codes.h"

namespace aureole {
namespace {

struct Flag {
  std::string name, help;  // with its dashes
  bool takes_value = false;
};

struct Command {
  std::string name, help;
  std::vector<Flag> flags;
  bool takes_files = false;
};

std::vector<Command> CommandsOf(const CLI::App& app) {
  std::vector<Command> out;
  for (const CLI::App* sub : app.get_subcommands([](const CLI::App*) { return true; })) {
    Command& c = out.emplace_back();
    c.name = sub->get_name();
    c.help = sub->get_description();
    for (const CLI::Option* option : sub->get_options()) {
      for (const std::string& name : option->get_lnames()) {
        c.flags.push_back({"--" + name, option->get_description(), option->get_items_expected_max() > 0});
      }
      c.takes_files |= option->get_positional() && option->get_type_name() == "FILE";
    }
  }
  return out;
}

std::string Names(const std::vector<Command>& commands) {
  return absl::StrJoin(commands, " ", [](std::string* out, const Command& c) { out->append(c.name); });
}

std::string FlagNames(const Command& command) {
  return absl::StrJoin(command.flags, " ", [](std::string* out, const Flag& f) { out->append(f.name); });
}

std::string Bash(const std::vector<Command>& commands) {
  std::string out =
      "_aureole() {\n"
      "  local word=${COMP_WORDS[COMP_CWORD]} command=${COMP_WORDS[1]} flags= files=\n"
      "  if ((COMP_CWORD == 1)); then\n";
  absl::StrAppend(&out, "    COMPREPLY=($(compgen -W '", Names(commands), " --help --version' -- \"$word\"))\n",
                  "    return\n  fi\n  case $command in\n");
  for (const Command& c : commands) {
    absl::StrAppend(&out, "    ", c.name, ") flags='", FlagNames(c), "' files=", c.takes_files ? "1" : "", " ;;\n");
  }
  return out +
         "  esac\n"
         "  if [[ $word == -* || -z $files ]]; then\n"
         "    COMPREPLY=($(compgen -W \"$flags\" -- \"$word\"))\n"
         "  else\n"
         "    COMPREPLY=($(compgen -f -- \"$word\"))\n"
         "  fi\n"
         "}\n"
         "complete -o filenames -F _aureole aureole\n";
}

std::string Quoted(const std::string& text) {
  return absl::StrReplaceAll(text, {{"'", ""}, {"[", "("}, {"]", ")"}, {":", ","}});
}

std::string Zsh(const std::vector<Command>& commands) {
  std::string out = "#compdef aureole\n_aureole() {\n  if ((CURRENT == 2)); then\n    local -a commands=(\n";
  for (const Command& c : commands) absl::StrAppend(&out, "      '", c.name, ":", Quoted(c.help), "'\n");
  out += "    )\n    _describe command commands\n    return\n  fi\n  case $words[2] in\n";
  for (const Command& c : commands) {
    absl::StrAppend(&out, "    ", c.name, ") _arguments");
    for (const Flag& f : c.flags) {
      absl::StrAppend(&out, " '", f.name, "[", Quoted(f.help), "]", f.takes_value ? ":value:_files" : "", "'");
    }
    absl::StrAppend(&out, c.takes_files ? " '*:file:_files'" : "", " ;;\n");
  }
  return out + "  esac\n}\ncompdef _aureole aureole\n";
}

std::string Fish(const std::vector<Command>& commands) {
  std::string out = "complete -c aureole -f\n";
  for (const Command& c : commands) {
    absl::StrAppend(&out, "complete -c aureole -n __fish_use_subcommand -a ", c.name, " -d '", Quoted(c.help), "'\n");
    const std::string when = absl::StrCat("complete -c aureole -n '__fish_seen_subcommand_from ", c.name, "'");
    for (const Flag& f : c.flags) {
      absl::StrAppend(&out, when, " -l ", f.name.substr(2), f.takes_value ? " -r" : "", " -d '", Quoted(f.help), "'\n");
    }
    if (c.takes_files) absl::StrAppend(&out, when, " -F\n");
  }
  return out;
}

}  // namespace

CLI::App* AddCompletion(CLI::App& app, CompletionOptions* o) {
  CLI::App* c = app.add_subcommand("completion", "A script that completes aureole's commands in a shell");
  c->add_option("shell", o->shell, "bash, zsh or fish")->required()->check(CLI::IsMember({"bash", "zsh", "fish"}));
  c->footer(std::string("Examples:\n"
                        "  source <(aureole completion bash)\n"
                        "  aureole completion fish > ~/.config/fish/completions/aureole.fish\n\n") +
            kExitCodesHelp);
  return c;
}

int RunCompletion(const CLI::App& app, const CompletionOptions& o) {
  const std::vector<Command> commands = CommandsOf(app);
  std::cout << (o.shell == "bash" ? Bash(commands) : o.shell == "zsh" ? Zsh(commands) : Fish(commands));
  return kExitOk;
}

}  // namespace aureole
