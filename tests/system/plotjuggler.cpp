// PlotJuggler's own ZeroMQ subscriber and MessagePack parser, without its window: listens to a
// port of this machine and prints the names of the series that it has made of what it heard, each
// with its number of points and its last value, in an endless loop.

#include <QApplication>
#include <QDialog>
#include <QSettings>
#include <QTimer>
#include <cstdio>
#include <cstdlib>

#include "datastream_zmq.h"
#include "nlohmann_parsers.h"

int main(int argc, char** argv)
{
  QApplication app(argc, argv);
  QCoreApplication::setOrganizationName("PlotJuggler");
  QSettings::setDefaultFormat(QSettings::IniFormat);
  QSettings::setPath(QSettings::IniFormat, QSettings::UserScope, argv[2]);
  QSettings settings;
  settings.setValue("ZMQ_Subscriber::protocol", "msgpack");
  settings.setValue("ZMQ_Subscriber::port", std::atoi(argv[1]));
  const bool stamped = argc > 3;  // the name of a field that has the time
  settings.setValue("NlohmannParser.msgpack.timestampEnabled", stamped);
  settings.setValue("NlohmannParser.msgpack.timestampFieldName", stamped ? argv[3] : "");
  settings.sync();

  // two, as its dialog takes notice of a choice that is another than the first
  PJ::ParserFactories parsers{{"json", std::make_shared<JSON_ParserFactory>()},
                              {"msgpack", std::make_shared<MessagePack_ParserFactory>()}};
  DataStreamZMQ streamer;
  streamer.setParserFactories(&parsers);
  QTimer::singleShot(0, [] {  // its dialog is accepted as it is
    qobject_cast<QDialog*>(QApplication::activeModalWidget())->accept();
  });
  if (!streamer.start(nullptr))
    return 1;

  QTimer print;
  QObject::connect(&print, &QTimer::timeout, [&streamer] {
    std::lock_guard<std::mutex> lock(streamer.mutex());
    for (const auto& [name, series] : streamer.dataMap().numeric)
      if (series.size())
        std::printf("%s\t%zu\t%.17g\t%.17g\n", name.c_str(), series.size(), series.back().x,
                    series.back().y);
    std::printf("\n");
    std::fflush(stdout);
  });
  print.start(500);
  return app.exec();
}
